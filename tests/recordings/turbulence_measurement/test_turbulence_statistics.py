"""What `calibrate task=turbulence` finds behind the camera is what the simulator put before it.

`-m slow -rP` prints what was found, the truth and the error.
"""

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from src.calibrate import measure_dot_statistics
from src.recordings import sensor_lookup, simulated_recording
from src.recordings.turbulence_measurement import dot_statistics, gaussian_dots
from src.sim import noise
from src.sim.optics import layout
from src.sim.turbulence.atmosphere import AR1_FPS, Atmosphere
from src.sim.turbulence.operator import Turbulence
from tests.recordings import pictures
from tests.recordings.turbulence_measurement.test_dot_statistics import sampling_error
from tests.test_recording_entry_points import config

pytestmark = pytest.mark.slow  # 6480 pictures through turbulence

SENSOR, SIDE, TILE, FPS, FRAMES, LONG = (360, 640), 120, 116.0, 120.0, 360, 6000
GRID = np.array([[x, y] for y in (30.0, 60.0, 90.0) for x in (30.0, 60.0, 90.0)])
MIDDLE, CENTRE, GROUND = 4, 4, 0.8
FLICKER = 0.2  # of the logarithm of a view's light: scintillation, which the simulator leaves out


def air(alpha: float, **views) -> Turbulence:
    """Return D/r0 3.3 with a tilt of 1.1 px."""
    atmosphere = Atmosphere(0.08, 0.8, 300.0, 0.25, 5.5e-7, 8e-14, alpha)
    positions = list(layout(9))
    return Turbulence(atmosphere, views=positions, height=SIDE, width=SIDE, fps=FPS, **views)


def calm_dots() -> torch.Tensor:
    """Return (1, h, w) with nine dark dots, 0.4 deep so that no flicker turns them black."""
    spread, depth = np.full((1, 9), 3.2), np.full((1, 9), -0.4)
    return torch.from_numpy(pictures.dot_grid(GRID[None], spread, depth, SIDE)).float()


def write(path: Path, views: torch.Tensor, camera) -> None:
    """Write what the sensor sees of `views` (9, frames, h, w) as a film of eight bits."""
    table, rng = sensor_lookup.build_lookup(camera), np.random.default_rng(3)
    light = simulated_recording.vignette_gain(table, 0.3)
    with h5py.File(path, "w") as file:
        film = file.create_dataset("frames", (views.shape[1], *SENSOR), np.uint8)
        for k in range(0, len(film), 40):
            seen = simulated_recording.render_sensor_frames(
                views[:, k : k + 40], table, light, slice(None)
            ).numpy()
            seen += rng.normal(0, 0.005, seen.shape)
            film[k : k + 40] = np.clip(255 * seen + 0.5, 0, 255).astype(np.uint8)


def mean_error(series: np.ndarray) -> float:
    """Return the standard error of the mean of a correlated series."""
    away = series - series.mean()
    lags = range(1, len(series) // 8)
    r = np.array([(away[:-k] * away[k:]).mean() for k in lags]) / away.var()
    return float(np.sqrt(away.var() * max(1 + 2 * r.sum(), 1) / len(series)))


def decay_error(a: float, frames: int) -> float:
    """Return the standard error, in frames, of where the correlation a^k of tilt falls to 1/e.

    Bartlett's variance of an autoregressive correlation at that lag, of two axes, over its slope.
    """
    k = -1 / np.log(a)
    variance = ((1 + a**2) * (1 - a ** (2 * k)) / (1 - a**2) - 2 * k * a ** (2 * k)) / frames
    return float(np.sqrt(variance / 2) * np.e * k)


def check(name: str, found: float, true: float, error: float, errors: float = 2) -> None:
    print(f"{name}: {found:.4f}, true {true:.4f}, error {error:.4f}")
    assert abs(found - true) < errors * error


@dataclass(frozen=True)
class Case:
    """What was simulated and what was found; `alike`: how many views are independent, and bring
    the error of their mean down by its root."""

    alpha: float
    alike: int
    turbulence: Turbulence
    views: torch.Tensor
    found: dot_statistics.DotStatistics


@pytest.fixture(
    scope="module",
    params=[(0.7, 9, {}), (0.85, 1, {"views_correlation": "baseline", "baseline_m": 0.08})],
    ids=["independent views", "shared air"],
)
def case(request, tmp_path_factory) -> Case:
    alpha, alike, shared = request.param
    folder, positions = tmp_path_factory.mktemp("dots"), list(layout(9))
    camera = simulated_recording.kaleidoscope_views(
        positions, model=(SIDE, SIDE), sensor=SENSOR, tile_px=TILE, key=5
    )
    turbulence, calm = air(alpha, **shared), calm_dots()
    views = turbulence.degrade(calm.expand(FRAMES, -1, -1)[None], noise.generator(4))[0]
    gain = np.exp(FLICKER * np.random.default_rng(1).normal(size=(9, FRAMES)))
    views = GROUND - torch.from_numpy(gain).float()[..., None, None] * (GROUND - views)
    camera.save(folder / "views.yaml")
    write(folder / "dots.h5", views, camera)
    write(folder / "still.h5", calm.expand(9, 12, -1, -1), camera)
    names = {"recording": "dots.h5", "still": "still.h5", "views": "views.yaml"}
    given = [f"{key}={folder / name}" for key, name in names.items()]
    cfg = config("calibrate", folder, "task=turbulence", f"fps={FPS}", *given)
    found = measure_dot_statistics(cfg, folder)
    assert found.failed.sum() < 0.01 * found.blur.size
    return Case(alpha, alike, turbulence, views, found)


def test_tilt_decays_as_the_simulators(case):
    tilts, lags = case.found.tilt[:, :, MIDDLE], len(case.found.lags_s)
    found = [
        dot_statistics.decay_time_s(dot_statistics.autocorrelate(tilt, lags), FPS) for tilt in tilts
    ]
    a = case.alpha ** (AR1_FPS / FPS)
    error = decay_error(a, FRAMES) / np.sqrt(case.alike)
    check("1/e of tilt, s", np.mean(found), -1 / np.log(a) / FPS, error / FPS)


def test_tilt_across_views_is_that_of_the_same_air_looked_at_for_longer(case):
    x, y = map(int, GRID[MIDDLE])
    long = case.turbulence.tilt(LONG, noise.generator(4), crop=(y, x, 1, 1))[..., 0, 0].numpy()
    pairs = np.triu_indices(9, 1)
    true = dot_statistics.tilt_correlation(long.swapaxes(0, 1))[pairs]
    assert abs(true.mean()) < 0.02 if case.alike == 9 else true.min() > 0.4
    error = sampling_error(long[CENTRE, :FRAMES]) * (1 - true**2)
    found = case.found.tilt_correlation_across_views[pairs]
    assert abs((found - true) / error).max() < 4
    apart = 36 if case.alike == 9 else 4  # pairs of views in shared air are not independent
    check("across views", found.mean(), true.mean(), error.mean() / np.sqrt(apart))


def test_blur_ratio_is_that_before_the_camera(case):
    before = [
        gaussian_dots.fit_gaussians(view.numpy(), GRID[[MIDDLE]], 10).blur[:, 0]
        for view in case.views
    ]
    still = gaussian_dots.fit_gaussians(calm_dots().numpy(), GRID[[MIDDLE]], 10).blur[0, 0]
    true = np.mean(before, axis=1) / still
    error = np.mean([mean_error(series) for series in before]) / still
    assert true.min() - 1 > 5 * error
    for found, of_view in zip(case.found.blur_over_still[:, MIDDLE], true, strict=True):
        check("blur ratio", found, of_view, error)


def test_scintillation_is_that_of_the_light_a_dot_takes_away(case):
    x, y = map(int, GRID[MIDDLE])
    patch = case.views[:, :, y - 15 : y + 16, x - 15 : x + 16].double().numpy()
    flux = (GROUND - patch).sum((2, 3))
    true = (flux.var(1) / flux.mean(1) ** 2).mean()
    error = true * np.sqrt(2 / FRAMES / 9)  # flicker is independent between frames and views
    check("scintillation", case.found.scintillation[:, MIDDLE].mean(), true, error, errors=1)
    assert case.found.still_scintillation[:, MIDDLE].max() < 1e-4
