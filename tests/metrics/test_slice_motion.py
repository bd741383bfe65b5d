"""Strayings of known size are found in slices."""

import warnings

import numpy as np
import pytest

from src.metrics import slice_motion


def edges(shift: np.ndarray, places: int = 100) -> np.ndarray:
    """Return a slice whose row k is a smooth pattern moved by `shift[k]` places."""
    x = np.arange(places) - shift[:, None]
    return 0.5 + 0.3 * np.tanh((x - 30) / 2) - 0.4 * np.tanh((x - 65) / 3)


@pytest.mark.parametrize("size", [0.1, 0.5, 1.5])
def test_wander_is_the_rms_shift_whatever_the_brightness(size):
    rng = np.random.default_rng(0)
    shift = size * rng.normal(size=200)
    rows = edges(shift) * rng.uniform(0.7, 1.3, (200, 1)) + 0.1 * rng.normal(size=(200, 1))
    assert slice_motion.residual_displacement_px(rows) == pytest.approx(shift.std(), rel=0.05)


def test_a_still_slice_does_not_wander_and_a_blank_one_has_no_answer():
    assert slice_motion.residual_displacement_px(edges(np.zeros(10))) < 1e-9
    assert np.isnan(slice_motion.residual_displacement_px(np.full((10, 50), 0.5)))


@pytest.mark.parametrize("lost", ["grey", "noise", "inverted"])
def test_rows_without_the_scene_do_not_count(lost):
    rng = np.random.default_rng(0)
    shift = 1.5 * rng.normal(size=200)
    rows = edges(shift)
    end = {
        "grey": 0.5 + 0 * rows,
        "noise": 0.5 + 0.01 * rng.normal(size=rows.shape),
        "inverted": -rows,
    }
    rows[120:] = end[lost][120:]
    found = slice_motion.residual_displacement_px(rows)
    assert found == pytest.approx(shift[:120].std(), rel=0.1)
    rows[90:] = end[lost][90:]
    if lost != "inverted":  # whose mean row is that of the rest
        assert np.isnan(slice_motion.residual_displacement_px(rows))


@pytest.mark.parametrize("size", [0.0, 0.3, 1.0])
def test_straightness_is_the_distance_from_the_line_of_uniform_motion(size):
    time, rng = np.arange(60), np.random.default_rng(0)
    centre = 15 + 1.1 * time + size * rng.normal(size=60)
    rows = 0.2 + 0.7 * np.exp(-((np.arange(100) - centre[:, None]) ** 2) / 18)
    true = centre - np.polyval(np.polyfit(time, centre, 1), time)
    assert slice_motion.line_deviation_px(rows) == pytest.approx(true.std(), abs=0.05)


@pytest.mark.parametrize("ends", [1, 2])
def test_turning_is_the_distance_from_uniform_turning_over_many_rounds(ends):
    time, rng, places = np.arange(80), np.random.default_rng(0), 120
    centre = 40 + 7.0 * time + 0.8 * rng.normal(size=80)
    apart = np.arange(places) - centre[:, None]
    period = places / ends
    apart = (apart + period / 2) % period - period / 2
    rows = 0.2 + 0.7 * np.exp(-(apart**2) / 18)
    true = centre - np.polyval(np.polyfit(time, centre, 1), time)
    assert slice_motion.uniform_rotation_deviation_px(rows) == pytest.approx(true.std(), abs=0.05)
    assert slice_motion.line_deviation_px(rows) > 10


def test_a_slice_in_which_nothing_moves_has_no_straightness():
    assert np.isnan(slice_motion.line_deviation_px(np.full((10, 50), 0.5)))
    assert np.isnan(slice_motion.uniform_rotation_deviation_px(np.full((10, 50), 0.5)))


def test_a_film_of_noise_shows_no_displacement_and_brings_no_warning():
    noise = np.random.default_rng(0).random((20, 64, 64))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = slice_motion.measure_static_scene(noise, 8)
    assert np.isnan(found["residual_displacement_px"]) and found["flicker"] > 1


def test_a_blank_film_does_not_stand_still():
    blank = slice_motion.measure_static_scene(np.full((6, 40, 40), 0.5, np.float32), 8)
    assert np.isnan(blank["flicker"]) and np.isnan(blank["residual_displacement_px"])


def test_flicker_is_change_over_contrast():
    scene = np.tile(np.sin(np.arange(40) / 3), (40, 1)).astype(np.float32)
    still = slice_motion.measure_static_scene(np.stack([scene] * 6), 8)
    assert still["flicker"] == 0 and still["residual_displacement_px"] < 1e-3
    assert still["contrast"] == pytest.approx(float(scene.std()), rel=1e-5)
    restless = np.stack([scene + 0.1 * (k % 2) for k in range(6)])
    assert slice_motion.measure_static_scene(restless, 8)["flicker"] == pytest.approx(
        0.1 / scene.std(), rel=1e-4
    )


def test_a_film_of_uint8_flickers_as_its_floats_do():
    film = np.random.default_rng(0).integers(0, 256, (6, 24, 24)).astype(np.uint8)
    found = slice_motion.measure_static_scene(film, 4)
    assert found["flicker"] == slice_motion.measure_static_scene(film.astype(float), 4)["flicker"]


def test_a_slice_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="kind must be one of line, circle, spin, got disc"):
        slice_motion.measure_slice_motion(np.eye(8), "disc")
