"""Views brought together: what is found of a known displacement, and what stays as it is."""

import math

import pytest
import torch
from torch import nn

from baselines.postprocess import CameraFrames
from src.metrics.temporal import pull
from src.models import load
from src.models.aligned import WAYS, Aligned, brought, displacement, leaked
from src.models.fast import running
from src.models.unroll import unroll
from src.sim.optics import layout

SIDE, VIEWS = 96, 9


class Mean(nn.Module):
    """The mean of all views' events of a window."""

    views = None

    def forward(self, voxels, state=None):
        return voxels.sum(2).mean(1, keepdim=True), state


def edges(seed: int = 0) -> torch.Tensor:
    """Return a smooth picture of log intensity, in events, (1, 1, h, w)."""
    drawn = torch.randn(1, 1, SIDE // 8, SIDE // 8, generator=torch.Generator().manual_seed(seed))
    return nn.functional.interpolate(drawn, SIDE, mode="bicubic")


def seen(picture: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Return one window of views that show `picture` displaced `by` (views, 2, h, w)."""
    views = pull(picture.expand(len(by), -1, -1, -1), -by)
    return views[None] / 5 * torch.ones(1, 1, 5, 1, 1)


def shifts(largest: float, seed: int = 1) -> torch.Tensor:
    """Return a displacement (views, 2, 1, 1) in pixels for each view, none in the mean."""
    drawn = torch.rand(VIEWS, 2, 1, 1, generator=torch.Generator().manual_seed(seed))
    return largest * (2 * (drawn - drawn.mean(0)))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("largest", [0.2, 1.0])
def test_a_view_that_lies_off_is_found_and_brought_back(way, largest):
    by = shifts(largest)
    voxels = seen(edges(), by.expand(-1, -1, SIDE, SIDE))
    found = displacement(leaked(None, voxels, 0.01), way)[0].mean((-2, -1))
    torch.testing.assert_close(found, by[..., 0, 0], atol=0.15 * largest, rtol=0)
    inside = (..., slice(8, -8), slice(8, -8))
    apart, together = (
        grids[inside].var(1).mean()
        for grids in (voxels, brought(voxels, found[None, ..., None, None]))
    )
    assert together < 0.1 * apart


def test_what_is_local_is_found_place_by_place():
    across = torch.linspace(-1, 1, SIDE).expand(SIDE, SIDE)  # one view is stretched
    by = torch.zeros(VIEWS, 2, SIDE, SIDE)
    by[0, 0], by[1, 0] = across, -across
    sums = leaked(None, seen(edges(), by), 0.01)
    whole, local = (displacement(sums, way)[0, 0, 0] for way in WAYS)
    assert whole.abs().max() < 0.15
    left, right = local[:, :3].mean(), local[:, -3:].mean()
    assert -1 < left < -0.5 and 0.5 < right < 1


def test_noise_moves_nothing_far_and_no_events_nothing():
    none = torch.zeros(1, VIEWS, 5, SIDE, SIDE)
    noise = (torch.rand(none.shape, generator=torch.Generator().manual_seed(2)) < 1e-3).float()
    for way in WAYS:
        assert displacement(leaked(None, none, 0.01), way).abs().max() == 0
        assert displacement(leaked(None, noise, 0.01), way).square().mean().sqrt() < 0.2


def test_one_view_is_left_alone():
    voxels = torch.rand(1, 3, 1, 5, 20, 24)
    plain, alone = (unroll(net, voxels)[0] for net in (Mean(), Aligned(Mean(), "local")))
    assert torch.equal(plain, alone)


@pytest.mark.parametrize("name", ["setnet_small", "lf3x3"])
@pytest.mark.parametrize("way", WAYS)
def test_a_sequence_is_its_windows_one_by_one_and_in_two_parts(name, way):
    voxels = torch.randn(2, 6, VIEWS, 5, 26, 30, generator=torch.Generator().manual_seed(3))
    net, options = Aligned(load(name), way), {"window_s": 1 / 300, "positions": layout(VIEWS)}
    with torch.no_grad():
        whole, _ = net.sequence(voxels, **options)
        first, state = net.sequence(voxels[:, :4], **options)
        second, _ = net.sequence(voxels[:, 4:], state, **options)
        single, state = [], None
        for window in voxels.unbind(1):
            frame, state = net(window, state, **options)
            single.append(frame)
    torch.testing.assert_close(torch.cat([first, second], 1), whole, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.stack(single, 1), whole, atol=1e-5, rtol=0)


def test_sums_fade_by_time_not_by_windows():
    voxels = torch.rand(1, 1, 5, 16, 16)
    after = leaked(leaked(None, voxels, 0.1), torch.zeros_like(voxels), 0.1)
    torch.testing.assert_close(after, math.exp(-2) * leaked(None, voxels, 0.1))


def test_a_faster_form_is_aligned_too():
    voxels = torch.randn(1, 4, VIEWS, 5, 24, 24, generator=torch.Generator().manual_seed(4))
    plain = Aligned(load("setnet_small"), "whole")
    fast = Aligned(running(load("setnet_small"), "bf16"), "whole")
    with torch.no_grad():
        torch.testing.assert_close(
            unroll(fast, voxels)[0], unroll(plain, voxels)[0], atol=0.05, rtol=0
        )


def test_wrong_ways_and_methods_without_a_state_are_refused():
    with pytest.raises(ValueError, match=r"align must be one of whole, local or null, got near"):
        Aligned(Mean(), "near")
    with pytest.raises(ValueError, match=r"align must be null for CameraFrames"):
        Aligned(CameraFrames(), "whole")
