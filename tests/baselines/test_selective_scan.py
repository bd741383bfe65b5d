"""The scan against its definition, its direction, and the curve."""

import pytest
import torch

from baselines.hilbert import hilbert_order
from baselines.selective_scan import BidirectionalMamba, selective_scan


def loop(x, step, rate, enter, leave):
    state, read = torch.zeros(len(x), *rate.shape).to(x), []
    for t in range(x.shape[1]):
        drive = step[:, t, :, None] * enter[:, t, None] * x[:, t, :, None]
        state = torch.exp(step[:, t, :, None] * rate) * state + drive
        read.append((state * leave[:, t, None]).sum(-1))
    return torch.stack(read, 1)


def inputs(length: int, n: int = 2, channels: int = 3, states: int = 4):
    torch.manual_seed(length)
    x, step = torch.randn(n, length, channels), torch.rand(n, length, channels) * 3
    enter, leave = torch.randn(2, n, length, states)
    return [a.double() for a in (x, step, -torch.rand(channels, states) * 4, enter, leave)]


@pytest.mark.parametrize("length", [1, 2, 9, 16, 57, 300])
def test_scan_is_the_loop(length):
    torch.testing.assert_close(selective_scan(*inputs(length)), loop(*inputs(length)))


@pytest.mark.parametrize("block", [1, 7, 57])
def test_blocks_go_on_from_each_other(block, monkeypatch):
    monkeypatch.setattr("baselines.selective_scan.BLOCK", block)
    torch.testing.assert_close(selective_scan(*inputs(57)), loop(*inputs(57)))


def test_gradients_are_the_loop_s():
    ours, theirs = inputs(30), inputs(30)
    for run, given in ((selective_scan, ours), (loop, theirs)):
        for part in given:
            part.requires_grad_()
        run(*given).sin().sum().backward()
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one.grad, other.grad)


def test_long_decays_stay_finite():
    x, step, rate, enter, leave = inputs(2000)
    assert torch.isfinite(selective_scan(x, step * 1e4, rate, enter, leave)).all()


@torch.no_grad()
def test_each_direction_sees_one_side_and_both_see_all():
    torch.manual_seed(0)
    mixer, x = BidirectionalMamba(8, 2), torch.randn(1, 20, 8)
    other = x.clone()
    other[:, 10] += 1
    first, second = mixer.ahead(*_inner(mixer, x)), mixer.ahead(*_inner(mixer, other))
    torch.testing.assert_close(first[:, :10], second[:, :10])
    assert not torch.allclose(first[:, 10:], second[:, 10:])
    changed = (mixer(x) - mixer(other)).abs().amax((0, 2)) > 0
    assert changed.all()


def _inner(mixer: BidirectionalMamba, x: torch.Tensor) -> tuple[torch.Tensor, None]:
    return mixer.enter(x).chunk(2, -1)[0], None


@torch.no_grad()
def test_a_guide_chooses():
    torch.manual_seed(0)
    mixer, x = BidirectionalMamba(8, 2, takes_guide=True), torch.randn(1, 12, 8)
    assert not torch.allclose(mixer(x, torch.zeros_like(x)), mixer(x, torch.ones_like(x)))


@pytest.mark.parametrize("sides", [(8, 8, 8), (4, 4, 4), (16, 16), (2, 2, 2)])
def test_curve_goes_from_neighbour_to_neighbour(sides):
    cells = torch.stack(torch.unravel_index(hilbert_order(*sides), sides), 1)
    assert (cells.diff(dim=0).abs().sum(1) == 1).all()


@pytest.mark.parametrize("sides", [(5, 6, 7), (1, 3, 9), (16, 22, 22), (1, 1, 1)])
def test_curve_meets_every_cell_once_and_stays_near(sides):
    order = hilbert_order(*sides)
    assert torch.equal(order.sort().values, torch.arange(len(order)))
    jumps = torch.stack(torch.unravel_index(order, sides), 1).diff(dim=0).abs().sum(1).float()
    assert len(jumps) == 0 or float(jumps.mean()) < 2
