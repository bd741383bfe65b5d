"""Fits at the accuracy noise allows; statistics against series of known correlation."""

import csv

import cv2
import numpy as np
import pytest

from src.calibrate import calibrate
from src.recordings.turbulence_measurement import dot_statistics, gaussian_dots
from tests.recordings.pictures import dot_grid
from tests.test_recording_entry_points import config

GRID = np.array([[x, y] for y in (20.0, 48.0, 76.0) for x in (20.0, 48.0, 76.0)])


def series(frames: int, count: int, alpha: float, seed: int = 0) -> np.ndarray:
    """Return AR(1) series (frames, count, 2) of unit variance."""
    rng = np.random.default_rng(seed)
    values = [rng.normal(size=(count, 2))]
    for _ in range(frames - 1):
        fresh = rng.normal(size=(count, 2))
        values.append(alpha * values[-1] + np.sqrt(1 - alpha**2) * fresh)
    return np.stack(values)


def sampling_error(tilt: np.ndarray) -> float:
    """Return the standard error of a correlation between two independent series like `tilt`.

    Bartlett's formula: variance (1 + 2 sum r(k)^2) / frames per axis, two axes averaged.
    """
    r = dot_statistics.autocorrelate(tilt, max(len(tilt) // 4, 2))
    return float(np.sqrt((1 + 2 * (r[1:] ** 2).sum()) / (2 * len(tilt))))


def noisy_grid(frames: int, noise: float, seed: int = 0):
    rng = np.random.default_rng(seed)
    centres = GRID + rng.normal(0, 1.2, (frames, 9, 2))
    sigma = 2.5 + rng.normal(0, 0.2, (frames, 9))
    amplitude = -0.6 * (1 + rng.normal(0, 0.05, (frames, 9)))
    pictures = dot_grid(centres, sigma, amplitude)
    return centres, sigma, amplitude, pictures + rng.normal(0, noise, pictures.shape)


def test_fits_reach_the_cramer_rao_bound():
    centres, sigma, amplitude, pictures = noisy_grid(60, noise=0.02)
    fits = gaussian_dots.fit_gaussians(pictures, GRID, radius=12)
    assert fits.is_fitted.all()
    # For a Gaussian on many pixels the bound on the centre is sqrt(2 / pi) noise / |A|.
    bound = np.sqrt(2 / np.pi) * 0.02 / 0.6
    assert (fits.centres - centres).std() == pytest.approx(bound, rel=0.15)
    assert abs((fits.blur - sigma).mean()) < 4 * bound / np.sqrt(fits.blur.size)
    truth = 2 * np.pi * np.abs(amplitude) * sigma**2
    assert (fits.flux / truth).mean() == pytest.approx(1, abs=0.005)


def test_a_dot_that_leaves_is_a_failure_and_not_a_number():
    centres, sigma, amplitude, _ = noisy_grid(20, noise=0.0)
    centres[10:, 4] += 60.0
    fits = gaussian_dots.fit_gaussians(dot_grid(centres, sigma, amplitude), GRID, radius=12)
    assert not fits.is_fitted[10:, 4].any()
    assert fits.is_fitted[:10].all() and fits.is_fitted[:, [0, 1, 2, 3, 5, 6, 7]].all()


def test_a_frame_that_is_not_finite_fails_alone():
    pictures = noisy_grid(4, noise=0.01)[3]
    pictures[2] = np.nan
    ok = gaussian_dots.fit_gaussians(pictures, GRID, radius=12).is_fitted
    assert not ok[2].any() and ok[[0, 1, 3]].all()


def test_fit_rejects_a_dot_outside_the_picture():
    with pytest.raises(ValueError, match="96x96 picture"):
        gaussian_dots.fit_gaussians(np.zeros((2, 96, 96)), np.array([[100.0, 5.0]]), radius=5)


@pytest.mark.parametrize("alpha", [0.5, 0.8])
def test_autocorrelation_of_a_known_series(alpha):
    frames = 40_000
    found = dot_statistics.autocorrelate(series(frames, 1, alpha)[:, 0], 8)
    spread = np.sqrt((1 + alpha**2) / (1 - alpha**2) / frames)  # Bartlett, one axis
    assert np.abs(found - alpha ** np.arange(8)).max() < 4 * spread


def test_autocorrelation_leaves_failures_out():
    tilt = series(5000, 1, 0.8)[:, 0]
    tilt[np.random.default_rng(1).random(5000) < 0.3] = np.nan
    assert dot_statistics.autocorrelate(tilt, 3) == pytest.approx([1, 0.8, 0.64], abs=0.06)


def test_correlation_of_mixed_series():
    first, second = series(20_000, 2, 0.5).swapaxes(0, 1)
    mixed = np.stack([first, 0.6 * first + 0.8 * second], axis=1)
    assert dot_statistics.tilt_correlation(mixed)[0, 1] == pytest.approx(0.6, abs=0.03)
    assert np.diag(dot_statistics.tilt_correlation(mixed)) == pytest.approx([1, 1])


def test_sampling_error_predicts_the_spread_between_independent_series():
    tilts = series(240, 200, 0.7)
    matrix = dot_statistics.tilt_correlation(tilts)
    spread = matrix[np.triu_indices(200, 1)].std()
    predicted = np.mean([sampling_error(tilts[:, i]) for i in range(50)])
    assert spread == pytest.approx(predicted, rel=0.15)


def test_decay_interpolates_between_lags():
    assert dot_statistics.decay_time_s(np.exp(-np.arange(10) / 3.0), fps=60.0) == pytest.approx(
        3 / 60, rel=0.01
    )
    assert dot_statistics.decay_time_s(np.ones(5), fps=60.0) == float("inf")


def test_scintillation_is_the_relative_variance():
    rng = np.random.default_rng(0)
    intensity = 1 + 0.1 * rng.normal(size=(2, 20_000, 3))
    assert dot_statistics.scintillation_index(intensity) == pytest.approx(
        np.full((2, 3), 0.01), rel=0.1
    )


def measured(frames: int = 40):
    turbulent = [
        gaussian_dots.fit_gaussians(noisy_grid(frames, 0.01, seed)[3], GRID, 12) for seed in (1, 2)
    ]
    calm = np.broadcast_to(GRID, (10, 9, 2))
    rng = np.random.default_rng(3)
    still = dot_grid(calm, np.full((10, 9), 2.0), np.full((10, 9), -0.6))
    reference = gaussian_dots.fit_gaussians(still + rng.normal(0, 0.01, still.shape), GRID, 12)
    return dot_statistics.compare_with_still(
        turbulent, [reference, reference], fps=60.0, centre_view=0
    )


def test_measure_compares_with_the_still_recording():
    found = measured()
    assert found.tilt.std() == pytest.approx(1.2, rel=0.1)
    assert found.blur_over_still == pytest.approx(np.full((2, 9), 2.5 / 2.0), rel=0.05)
    assert (found.scintillation > 3 * found.still_scintillation).all()
    assert found.failed.sum() == 0
    assert found.centre_view_correlation.shape == (
        9,
        9,
    ) and found.tilt_correlation_across_views.shape == (2, 2)


def test_a_grid_that_lies_elsewhere_is_not_tilted():
    fits = []
    for frames, away in ((10, 0.0), (40, 1.5)):
        centres = np.broadcast_to(GRID + away, (frames, 9, 2))
        seen = dot_grid(centres, np.full((frames, 9), 2.0), np.full((frames, 9), -0.6))
        seen = seen + np.random.default_rng(frames).normal(0, 0.01, seen.shape)
        fits.append(gaussian_dots.fit_gaussians(seen, GRID, 12))
    still, moved = fits
    found = dot_statistics.compare_with_still([moved], [still], fps=60.0, centre_view=0).summary()
    assert found["tilt_rms_px"] < 0.05 and found["still_tilt_rms_px"] < 0.05
    assert found["mean_displacement_px"] == pytest.approx(1.5 * np.sqrt(2), rel=0.02)


def test_measure_rejects_a_dot_without_a_reference():
    pictures = noisy_grid(5, 0.01)[3]
    good = gaussian_dots.fit_gaussians(pictures, GRID, 12)
    empty = gaussian_dots.fit_gaussians(np.zeros_like(pictures), GRID, 12)
    with pytest.raises(ValueError, match="every dot must be fitted"):
        dot_statistics.compare_with_still([good], [empty], fps=60.0, centre_view=0)


def test_csv_has_a_row_per_view_and_dot(tmp_path):
    dot_statistics.write_view_dot_csv(measured(), tmp_path / "dots.csv", [(0, 0), (0, 1)])
    with open(tmp_path / "dots.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 18
    assert float(rows[0]["blur_over_still"]) == pytest.approx(1.25, rel=0.05)


def test_find_dots_orders_row_by_row():
    picture = noisy_grid(1, 0.01)[3][0]
    found = dot_statistics.find_dots(picture, 3, 3)
    assert np.abs(found - GRID).max() < 5


def test_find_dots_rejects_a_picture_without_them():
    with pytest.raises(ValueError, match="3x3 grid"):
        dot_statistics.find_dots(np.random.default_rng(0).random((96, 96)), 3, 3)


def write_film(folder, frames: int, side: int = 96):
    """Return a folder of `frames` pictures of the dots, with `side` pixels a side."""
    folder.mkdir()
    sigma, depth = np.full((frames, 9), 2.5), np.full((frames, 9), -0.6)
    seen = dot_grid(np.broadcast_to(GRID, (frames, 9, 2)), sigma, depth, side)
    for number, picture in enumerate(seen):
        cv2.imwrite(str(folder / f"{number:03}.png"), np.round(picture.clip(0, 1) * 255))
    return folder


@pytest.mark.parametrize(
    "wrong, message",
    [
        ("fps=0", r"fps must be in \[0.02, 1e5\] frames a second, got 0"),
        ("fps=inf", r"fps must be in \[0.02, 1e5\] frames a second, got inf"),
        ("fps=1e30", r"fps must be in \[0.02, 1e5\] frames a second, got 1e\+30"),
        ("dots.rows=0", r"dots.rows and dots.cols must be in 3\.\.100, got 0 and 3"),
        ("still={folder}/none", "still must be a film or a folder of pictures, got .*none"),
        ("still={folder}/larger", r"still must have pictures of the .* size, 96x96, got 120x120"),
        ("still={folder}/text", "still must be a readable picture of at most .*text/0.png"),
        ("still={folder}/nowhere", "still must be .*, got .*nowhere, which does not exist"),
    ],
)
def test_calibrate_refuses_wrong_films_before_it_fits(wrong, message, tmp_path, monkeypatch):
    monkeypatch.delattr(gaussian_dots, "fit_gaussians")
    dots, still = (write_film(tmp_path / name, 2) for name in ("dots", "still"))
    write_film(tmp_path / "larger", 2, 120)
    (tmp_path / "none").mkdir()
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "0.png").write_text("no picture")
    given = ["task=turbulence", f"recording={dots}", f"still={still}", "fps=60"]
    given.append(wrong.format(folder=tmp_path))
    with pytest.raises(ValueError, match=message) as caught:
        calibrate(config("calibrate", tmp_path / "run", *given))
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "run").iterdir())


def test_ground_follows_the_vignette_under_the_dots():
    y, x = np.mgrid[:96, :96] / 47.5 - 1
    light = 1 - 0.25 * (x**2 + y**2) + 0.05 * x
    dots_seen = dot_grid(GRID[None], np.full((1, 9), 2.5), np.full((1, 9), -0.6))[0] / 0.8
    found = dot_statistics.fit_background(light * dots_seen, GRID, 9)
    assert np.abs(found - light).max() < 0.005
