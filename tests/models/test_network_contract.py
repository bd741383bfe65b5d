"""What every network must do: chunks, batches, gradients, learning; each row has its own bounds."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import pytest
import torch
from torch import nn
from torch.nn.functional import avg_pool2d

from baselines.cista import CISTA
from baselines.firenet import FireNet
from src.models.network import unroll
from tests.baselines import test_networks
from tests.models import test_e2vid, test_setnet
from tests.models.learning import learn_by_heart


class ByHeart(NamedTuple):
    """A batch (clips, windows, views, side) and how far it is learned."""

    batch: tuple[int, int, int, int]
    rate: float
    steps: int
    ratio: float  # of the last loss and the first


class Subject(NamedTuple):
    """A small network, and the batch (clips, windows, views, side) it is tried on.

    `first`: windows of the first of two chunks.  `close`: how near clips of a batch are to clips
    alone.  `gradient_windows`: until every parameter counts.
    """

    make: Callable[..., nn.Module]
    batch: tuple[int, int, int, int]
    first: int
    close: Mapping[str, float]
    gradient_windows: int
    by_heart: ByHeart
    learner: Mapping[str, int] = {}  # other arguments of the network that learns


def frozen(kind: type) -> Subject:
    steps = 40 if kind in (FireNet, CISTA) else 20
    make, by_heart = partial(test_networks.small, kind), ByHeart((1, 3, 9, 16), 5e-3, steps, 0.5)
    return Subject(make, (1, 3, 9, 24), 1, {}, 3, by_heart)


def e2vid(recurrent: str) -> Subject:
    make = partial(test_e2vid.small, recurrent=recurrent)
    close, by_heart = {"atol": 1e-6, "rtol": 1e-5}, ByHeart((2, 4, 2, 16), 3e-3, 30, 0.25)
    return Subject(make, (2, 4, 2, 16), 1, close, 4, by_heart, {"base_channels": 8})


SUBJECTS = {kind.__name__: frozen(kind) for kind in test_networks.PUBLISHED} | {
    "E2VID": e2vid("convlstm"),
    "E2VID of ConvGRU": e2vid("convgru"),
    "SetNet": Subject(
        test_setnet.small, (1, 4, 9, 16), 2, {}, 6, ByHeart((2, 4, 2, 16), 1e-2, 60, 0.25)
    ),
}
all_subjects = pytest.mark.parametrize("subject", SUBJECTS.values(), ids=SUBJECTS)


def voxels(clips: int, windows: int, views: int, side: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(clips, windows, views, 3, side, side, generator=generator)


@all_subjects
@torch.no_grad()
def test_law_6_two_chunks_equal_one(subject):
    network, windows = subject.make(), voxels(*subject.batch)
    whole, _ = unroll(network, windows)
    first, state = unroll(network, windows[:, : subject.first])
    second, _ = unroll(network, windows[:, subject.first :], state)
    assert torch.equal(whole, torch.cat([first, second], 1))


@all_subjects
@torch.no_grad()
def test_clips_of_a_batch_do_not_meet(subject):
    windows = voxels(2, *subject.batch[1:])
    together, _ = unroll(subject.make(), windows)
    alone, _ = unroll(subject.make(), windows[1:])
    torch.testing.assert_close(together[1:], alone, **subject.close)


@all_subjects
def test_gradients_reach_every_parameter(subject):
    clips, _, views, side = subject.batch
    network = subject.make().train()
    frames, _ = unroll(network, voxels(clips, subject.gradient_windows, views, side))
    (frames * torch.randn_like(frames)).sum().backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in network.parameters())


@all_subjects
def test_it_can_learn_one_batch_by_heart(subject):
    (clips, length, views, side), rate, steps, ratio = subject.by_heart
    network = subject.make(**subject.learner).train()
    windows = voxels(clips, length, views, side)
    target = torch.rand(clips * length, 1, side, side, generator=torch.Generator().manual_seed(2))
    target = avg_pool2d(target, 5, 1, 2).unflatten(0, (clips, length))
    draw = lambda: unroll(network, windows)[0]  # noqa: E731
    assert learn_by_heart(network, draw, target, rate, steps, ratio)
