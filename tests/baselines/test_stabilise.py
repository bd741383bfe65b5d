"""A video held still by its own motion: what shakes is found, what flies on is left alone."""

import pytest
import torch

from baselines.stabilise import (
    ERROR,
    backward_warp_video,
    estimate_jitter,
    local_linear_smoothing_matrix,
)


def scene(paths: torch.Tensor, side: int = 96) -> torch.Tensor:
    """Return (1, frames, 1, side, side): a smooth texture moved along `paths` (frames, 2)."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 12, generator=generator) * 0.25
    phase = torch.rand(12, generator=generator) * 6.28
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    waves = [
        (a * (x - px)[..., None] + b * (y - py)[..., None] + phase).sin().mean(-1)
        for px, py in paths.tolist()
        for a, b in [noise]
    ]
    return 0.5 + 0.9 * torch.stack(waves)[None, :, None]


def shake(frames: int, px: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return px * torch.randn(frames, 2, generator=generator)


def rest(path: torch.Tensor) -> torch.Tensor:
    """Return what of a path (frames, 2) is no smooth motion."""
    return path - local_linear_smoothing_matrix(len(path)) @ path


def inner(field: torch.Tensor) -> torch.Tensor:
    """Return the mean over the middle of (1, frames, 2, h, w): the border sees other things."""
    return field[0, ..., 24:-24, 24:-24].mean((-2, -1))


def test_a_shake_is_found():
    path = shake(12, 0.8)
    expected = rest(path)
    expected = expected / (1 + ERROR**2 / expected.square().mean())  # Wiener's gain
    found = inner(estimate_jitter(scene(path)))
    assert float((found - expected).square().mean().sqrt()) < 0.08


def test_steady_flight_is_no_jitter():
    flight = torch.arange(12.0)[:, None] * torch.tensor([0.7, -0.4])
    assert float(inner(estimate_jitter(scene(flight))).abs().max()) < 0.08


def test_pulling_takes_the_shake_out():
    path, still = shake(12, 0.5), scene(torch.zeros(12, 2))
    shaken = scene(rest(path))
    steady = backward_warp_video(shaken, estimate_jitter(shaken))
    middle = (..., slice(24, -24), slice(24, -24))
    before, after = ((video - still)[middle].square().mean() for video in (shaken, steady))
    assert float(after) < 0.1 * float(before)


def test_straight_paths_come_through_the_smoother():
    line = torch.stack([torch.ones(9), torch.arange(9.0)], 1)
    torch.testing.assert_close(local_linear_smoothing_matrix(9) @ line, line, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_videos(frames):
    shift = estimate_jitter(torch.rand(2, frames, 1, 32, 24))
    assert shift.shape == (2, frames, 2, 32, 24) and torch.isfinite(shift).all()
    if frames <= 2:  # two points lie on a line
        assert float(shift.abs().max()) < 1e-4
