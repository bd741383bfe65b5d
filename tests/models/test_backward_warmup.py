"""Reading a clip backwards first: what a sum of events makes of it, and what is refused."""

import math

import pytest
import torch

from baselines.postprocess import CameraFrames
from src.models.backward_warmup import BackwardWarmup, reverse_voxels
from src.models.network import EventToVideoNetwork
from src.sim.pipeline import Sample
from src.sim.voxel import voxel_grid


class Sums(EventToVideoNetwork):
    """The sum of all events so far: what changed since it began."""

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        change = voxels.sum((1, 2))[:, None]
        state = change if state is None else state + change
        return state, state


def sample(windows: int = 12) -> Sample:
    drawn = torch.Generator().manual_seed(0)
    voxels = torch.randn(1, windows, 2, 5, 8, 8, generator=drawn)
    pictures = torch.zeros(1, windows, 1, 8, 8)
    return Sample(voxels, pictures, pictures, torch.tensor([0.01]))


def test_a_sum_that_looked_ahead_is_what_is_missing_to_there():
    clip = sample()
    once, ahead = (
        method.reconstruct_clip(clip) for method in (Sums(), BackwardWarmup(Sums(), 0.08))
    )
    torch.testing.assert_close(ahead, once - once[:, 7:8])  # 0 at the end of what it looked at
    longer = BackwardWarmup(Sums(), 60.0).reconstruct_clip(clip)
    torch.testing.assert_close(longer, once - once[:, -1:])  # no further than the clip


def test_a_reversed_grid_is_that_of_the_events_backwards():
    drawn = torch.Generator().manual_seed(1)
    t = torch.rand(300, generator=drawn).double().sort().values
    x, y = torch.randint(0, 16, (2, 300), generator=drawn)
    p = torch.randint(0, 2, (300,), generator=drawn) * 2 - 1
    size = {"t0": 0.0, "t1": 1.0, "bins": 5, "height": 16, "width": 16}
    forth = voxel_grid(t, x, y, p, **size)
    back = voxel_grid((1 - t).flip(0), x.flip(0), y.flip(0), -p.flip(0), **size)
    torch.testing.assert_close(reverse_voxels(forth), back, atol=1e-5, rtol=0)


@pytest.mark.parametrize("seconds", [-1.0, math.inf, math.nan])
def test_a_length_that_is_none_is_refused(seconds):
    with pytest.raises(ValueError, match=r"backward_warmup_s must be >= 0 seconds and finite, got"):
        BackwardWarmup(Sums(), seconds)


def test_a_method_without_a_state_is_refused():
    with pytest.raises(ValueError, match=r"backward_warmup_s must be 0 for CameraFrames"):
        BackwardWarmup(CameraFrames(), 1.0)
