"""Displacement, jitter and paths on sequences whose motion is known."""

import pytest
import skimage
import torch
from scipy import ndimage
from torch.nn import functional

from src.metrics.temporal import estimate_block_displacement, temporal_jitter_px

FRAMES, SIDE = 12, 128


def photo(shifts: torch.Tensor, blur: float = 0.0) -> torch.Tensor:
    """The camera man shifted by (x, y) pixels per frame, sampled from a larger picture."""
    picture = torch.from_numpy(skimage.data.camera() / 255.0).float()[None, None]
    picture = functional.avg_pool2d(picture, 2)
    y, x = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    grid = torch.stack([x, y], -1) + 64.0 - shifts[:, None, None]
    grid = (2 * grid + 1) / 256 - 1
    frames = functional.grid_sample(
        picture.expand(len(shifts), -1, -1, -1), grid, mode="bicubic", align_corners=False
    )
    return functional.avg_pool2d(frames, 3, 1, 1, count_include_pad=False) if blur else frames


def swing(amplitude: float) -> torch.Tensor:
    time = torch.arange(FRAMES) * 0.9
    return amplitude * torch.stack([time.sin(), (1.3 * time).cos()], 1)


STILL = torch.zeros(FRAMES, 2)


@pytest.mark.parametrize("amplitude", [0.2, 0.7, 1.8, 4.0])
@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_known_shifts_are_found(amplitude, gain):
    shifts = swing(amplitude)
    found, weight = estimate_block_displacement(0.2 + gain * photo(shifts), photo(STILL))
    mean = (found * weight[:, None]).sum((2, 3)) / weight.sum((1, 2))[:, None]
    assert torch.allclose(mean, shifts, atol=0.05 + 0.04 * amplitude)


@pytest.mark.parametrize("amplitude", [0.2, 0.7, 1.8, 4.0])
def test_jitter_of_a_known_swing(amplitude):
    shifts = swing(amplitude)
    frames, target = photo(shifts), photo(STILL)
    change = (shifts[1:] - shifts[:-1]).square().mean(1).sqrt()
    assert torch.allclose(temporal_jitter_px(frames, target), change, atol=0.06 + 0.08 * amplitude)


def test_noise_and_blur_hardly_jitter():
    noise = 0.03 * torch.randn(FRAMES, 1, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    assert float(temporal_jitter_px(photo(STILL, blur=1.0) + noise, photo(STILL)).mean()) < 0.2


@pytest.mark.parametrize(
    ("speed", "sigma_px", "read_px"),
    [(1, 2, 0.1), (1, 4, 0.3), (3, 2, 0.3), (3, 4, 0.7), (0, 4, 0.0)],
)
def test_blur_of_what_moves_reads_as_it_says(speed, sigma_px, read_px):
    target = photo(speed * torch.arange(FRAMES)[:, None] * torch.tensor([[0.7, 0.3]]))
    blurred = torch.from_numpy(ndimage.gaussian_filter(target.numpy(), (0, 0, sigma_px, sigma_px)))
    jitter = temporal_jitter_px(blurred, target).mean()
    assert float(jitter) == pytest.approx(read_px, abs=0.05)


def test_motion_that_is_in_the_truth_is_no_jitter():
    moving = photo(swing(1.5))
    assert float(temporal_jitter_px(0.5 * moving, moving).max()) < 1e-3


def test_flat_pictures_have_no_displacement():
    flat = torch.full((3, 1, 32, 32), 0.5)
    assert torch.all(temporal_jitter_px(flat, flat) == 0)


def test_flat_reconstruction_of_a_textured_truth_is_finite():
    assert torch.isfinite(
        temporal_jitter_px(torch.full((FRAMES, 1, SIDE, SIDE), 0.5), photo(STILL))
    ).all()
