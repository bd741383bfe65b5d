"""By how much the picture moves when the whole view is tilted: light in the halo stays."""

import cv2
import numpy as np
import pytest

from src.sim.turbulence import Atmosphere, sample_atmosphere
from src.sim.turbulence.operator import Turbulence
from tests.sim.turbulence.test_turbulence import leaves, seed

SIDE, FRAMES, BORDER, APERTURE_M, PIXEL_D, WAVELENGTH_M = 160, 24, 24, 0.05, 1 / 30, 525e-9


def turbulence_at_the_camera(strength: float, unit_px: float, tolerance: float) -> Turbulence:
    """Return turbulence whose tilt is nearly one for all places, lambda / D of `unit_px`."""
    pixel = PIXEL_D * APERTURE_M
    path = Atmosphere(
        aperture_m=APERTURE_M, focal_length_m=1.0, wavelength_m=WAVELENGTH_M,
        distance_m=unit_px * APERTURE_M * pixel / WAVELENGTH_M, scene_width_m=pixel * SIDE,
        cn2=(1.0, *[0.0] * 29), ar1_coefficient=0.0,
    ).with_d_over_r0(strength)  # fmt: skip
    return Turbulence(path, views=1, height=SIDE, width=SIDE, fps=120.0, tolerance=tolerance)


def find_shift(frame: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the shift (x, y) in pixels of a frame against the mean, by least squares."""
    shift, inside = np.zeros(2), (slice(BORDER, -BORDER),) * 2
    for _ in range(8):
        matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
        moved = cv2.warpAffine(
            mean, matrix, mean.shape, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        slopes = np.stack([-g[inside].ravel() for g in np.gradient(moved)[::-1]], 1)
        shift += np.linalg.lstsq(slopes, (frame - moved)[inside].ravel(), rcond=None)[0]
    return shift


@pytest.mark.parametrize(
    ("strength", "unit_px", "tolerance", "least"),
    [
        (5.0, 0.7, 0.26, 0.75),
        pytest.param(2.0, 1.5, 0.26, 0.85, marks=pytest.mark.slow),
        pytest.param(5.0, 1.5, 0.26, 0.8, marks=pytest.mark.slow),
        pytest.param(5.0, 1.5, 0.02, 0.95, marks=pytest.mark.slow),
    ],
)
def test_the_picture_moves_by_nearly_the_tilt(strength, unit_px, tolerance, least):
    turbulence = turbulence_at_the_camera(strength, unit_px, tolerance)
    picture = leaves(SIDE).expand(1, FRAMES, SIDE, SIDE)
    film = turbulence.degrade(picture, seed(5))[0, 0].numpy()
    tilt = turbulence.tilt(FRAMES, seed(5))[0, ..., BORDER:-BORDER, BORDER:-BORDER].mean((2, 3))
    given, share = (tilt - tilt.mean(0)).numpy(), turbulence.halo.share
    slopes = []
    for blur_px in (0, 4):
        seen = [cv2.GaussianBlur(f, (0, 0), blur_px) if blur_px else f for f in film]
        found = np.stack([find_shift(frame, np.mean(seen, 0)) for frame in seen])
        slopes.append(float(((found - found.mean(0)) * given).sum() / (given**2).sum()))
    numbers = f"halo {share:.3f}, moved {slopes[0]:.2f}, low-passed {slopes[1]:.2f} of the tilt"
    print(f"D/r0 {strength}, lambda/D {unit_px} px, tolerance {tolerance}: {numbers}")
    assert all(least < slope < 1.01 for slope in slopes) and share < 0.25


@pytest.mark.slow
@pytest.mark.parametrize("severity", ["weak", "medium", "strong"])
def test_the_halo_of_drawn_turbulence_holds_a_small_share(severity):
    size = {"views": 1, "height": 192, "width": 192, "fps": 120.0}
    paths = [sample_atmosphere(severity, seed(number)) for number in range(60)]
    shares = [Turbulence(path, **size).halo.share for path in paths]
    low, middle, high = np.percentile(shares, [10, 50, 90])
    print(f"{severity}: halo {low:.3f} / {middle:.3f} / {high:.3f}, at most {max(shares):.2f}")
    assert max(shares) < 0.25
