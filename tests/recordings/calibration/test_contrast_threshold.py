"""Event rates and the threshold found by them, on recordings whose threshold is known."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from src.figures import calibration_figures
from src.recordings.calibration import contrast_threshold
from src.recordings.files.event_file import EVENT
from src.recordings.files.event_writers import write_events
from src.recordings.files.recording import open_recording
from src.sim.sensor.sensor import EventSensor

FPS = 120.0
GRID = np.geomspace(0.08, 0.8, 12).tolist()


def scene(seed: int, frames: int = 24, side: int = 48) -> torch.Tensor:
    """One view of smooth texture that moves: (1, frames, side, side)."""
    g = torch.Generator().manual_seed(seed)
    wide = side + 2 * frames
    texture = torch.nn.functional.avg_pool2d(torch.randn(1, 1, wide, wide, generator=g), 5, 1, 2)
    texture = 0.45 + 0.35 * torch.tanh(3 * texture[0, 0])
    return torch.stack([texture[k : k + side, 2 * k : 2 * k + side] for k in range(frames)])[None]


def recorded(sensor: EventSensor, clips) -> list[np.ndarray]:
    """The events of clips one after the other, as a recording in pieces."""
    pieces, start = [], 0
    for index, clip in enumerate(clips):
        events = sensor.events(clip[0], FPS, clip=index)
        events["t"] += start
        start += round((clip.shape[1] - 1) * 1e6 / FPS)
        pieces.append(events)
    return pieces


@pytest.mark.parametrize(
    ("on", "off_ratio", "refractory_s"), [(0.15, 1.0, 0.005), (0.3, 1.0, 0.0), (0.25, 1.4, 0.005)]
)
def test_a_known_threshold_is_found(on, off_ratio, refractory_s):
    """Recording and simulation see different parts of one kind of scene."""
    settings = {"refractory_s": refractory_s}
    camera = EventSensor(on, off_ratio=off_ratio, **settings)
    recording = recorded(camera, [scene(seed) for seed in range(8)])
    measured = contrast_threshold.measure_event_rates(
        recording, np.zeros((48, 48), np.int64), slices=40
    )
    others = [scene(seed) for seed in range(100, 106)]
    found = contrast_threshold.estimate_contrast_threshold(
        measured, others, FPS, EventSensor(**settings), GRID
    )
    assert abs(np.log(found.on[0] / on)) < 0.12
    assert abs(np.log(found.off[0] / (on * off_ratio))) < 0.12
    assert found.on[1] < found.on[0] < found.on[2]
    assert found.off[1] < found.off[0] < found.off[2]


def trembling(seed: int, frames: int, side: int = 24) -> torch.Tensor:
    """One view whose light trembles about its mean, 1/e after 0.1 s: (1, frames, side, side)."""
    g = torch.Generator().manual_seed(seed)
    drawn, kept = 0.2 * torch.randn(frames, side, side, generator=g), np.exp(-10 / FPS)
    for before, now in pairwise(drawn):
        now.mul_(np.sqrt(1 - kept**2)).add_(before, alpha=kept)
    return torch.exp(drawn - 1.5).clamp(max=1)[None]


def trembling_recording(camera: EventSensor) -> contrast_threshold.EventRates:
    """Eight recordings of a third of a second each by a camera that has run for two seconds."""
    clips = [trembling(seed, 281) for seed in range(8)]
    counts = [camera.counts(c[None], FPS, [k], first_interval=240)[0] for k, c in enumerate(clips)]
    return contrast_threshold.EventRates(
        torch.stack(counts).numpy(), np.array([24**2]), np.array([0]), 40 / FPS
    )


def test_the_threshold_of_a_camera_that_has_run_is_found_in_a_scene_at_rest():
    """Each reference settles once, by an event, wherever it begins."""
    camera = EventSensor(0.4, refractory_s=0.0, dark_noise_hz=0.2)
    measured = trembling_recording(camera)
    clips = [trembling(seed, 121) for seed in range(100, 104)]
    unknown = replace(camera, initial_reference_error=1.0)
    found = contrast_threshold.estimate_contrast_threshold(measured, clips, FPS, unknown, warmup=80)
    assert found.on[1] < 0.4 < found.on[2]
    assert abs(np.log(found.on[0] / 0.4)) < 0.1
    late = [clip[:, 80:] for clip in clips]
    cold = contrast_threshold.estimate_contrast_threshold(measured, late, FPS, unknown)
    assert cold.on[1] > 0.4 and cold.on[0] > 1.1 * 0.4


def test_the_share_of_noise_is_that_of_the_sensor_without_change_of_light():
    camera = EventSensor(0.8, refractory_s=0.0, dark_noise_hz=1.0)
    measured = trembling_recording(camera)
    found = contrast_threshold.estimate_contrast_threshold(
        measured, [trembling(100, 121)], FPS, camera, warmup=80
    )
    noise_hz = 1 - 0.75 * np.exp(-1.5 + 0.2**2 / 2)
    assert found.noise.sum() == pytest.approx(noise_hz, rel=0.1)
    assert found.noise_share == pytest.approx(noise_hz / measured.pooled.sum(), rel=0.1)


def test_the_same_scene_gives_the_threshold_exactly():
    clips = [scene(seed) for seed in range(3)]
    recording = recorded(EventSensor(0.2), clips)
    measured = contrast_threshold.measure_event_rates(
        recording, np.zeros((48, 48), np.int64), slices=40
    )
    found = contrast_threshold.estimate_contrast_threshold(
        measured, clips, FPS, EventSensor(), GRID
    )
    assert abs(found.on[0] / 0.2 - 1) < 0.02 and abs(found.off[0] / 0.2 - 1) < 0.02


@pytest.mark.parametrize(("on", "off_ratio"), [(0.2, 1.4), (0.3, 0.6)])
def test_thresholds_that_differ_are_found_where_a_faint_scene_trembles(on, off_ratio):
    """Near the threshold the quotient of rates changes by more than the ratio of thresholds."""
    shift = 0.3 * torch.randn(40, 1, 1, generator=torch.Generator().manual_seed(1))
    waves = torch.linspace(0.1, 1.2, 48)[None, :, None] * (torch.arange(48.0) + shift)
    clip = (0.5 + 0.15 * torch.sin(waves))[None]
    counts = EventSensor(on, off_ratio=off_ratio).counts(clip[None], FPS, clips=[0])[0].sum(0)
    events = np.random.default_rng(0).poisson(counts.numpy() / 39, (39, 1, 2))
    measured = contrast_threshold.EventRates(events, np.array([48**2]), np.array([0]), 1 / FPS)
    found = contrast_threshold.estimate_contrast_threshold(measured, [clip], FPS, EventSensor())
    assert abs(found.on[0] / on - 1) < 0.05 and abs(found.off[0] / (on * off_ratio) - 1) < 0.05
    assert found.on[1] < found.on[0] < found.on[2]
    assert found.off[1] < found.off[0] < found.off[2]


def test_a_quotient_of_rates_that_no_ratio_makes_is_named():
    clips = [scene(0)]
    measured = contrast_threshold.measure_event_rates(
        recorded(EventSensor(0.2), clips), np.zeros((48, 48), np.int64), slices=10
    )
    events = np.rint(measured.events * np.array([20, 1 / 20])).astype(int)
    lopsided = replace(measured, events=events)
    with pytest.raises(ValueError, match="quotient of ON to OFF rate.* is not made by any ratio"):
        contrast_threshold.estimate_contrast_threshold(lopsided, clips, FPS, EventSensor(), GRID)


def test_rates_of_views_are_events_per_pixel_and_second():
    view = np.full((6, 10), -1)
    view[:, :4], view[:3, 6:] = 0, 1
    events = np.zeros(600, EVENT)
    g = np.random.default_rng(0)
    events["t"] = np.linspace(0, 2e6 - 1, 600).astype(np.int64)
    events["x"], events["y"] = g.integers(0, 10, 600), g.integers(0, 6, 600)
    events["p"] = g.choice([-1, 1], 600)
    measured = contrast_threshold.measure_event_rates([events[:250], events[250:]], view, slices=7)
    for index, pixels in enumerate((24, 12)):
        mine = events["p"][view[events["y"], events["x"]] == index]
        assert measured.pixels[index] == pixels
        expected = np.array([(mine > 0).sum(), (mine < 0).sum()]) / (pixels * 2.0)
        assert np.allclose(measured.per_view[index], expected)
    assert measured.events.shape == (7, 2, 2)


def test_hot_pixels_do_not_count():
    """Above what texture makes; a pixel no busier than the scene around it is left alone."""
    calm = 0.5 + 0.2 * (scene(0) - 0.5)
    camera = {"threshold": 0.2, "refractory_s": 0.0, "seed": 1}
    view = np.zeros((48, 48), np.int64)
    plain, broken = (
        contrast_threshold.measure_event_rates(
            recorded(EventSensor(**camera, **hot), [calm]), view, slices=10
        )
        for hot in ({}, {"hot_pixel_fraction": 0.004, "hot_pixel_hz": 119.0})
    )
    assert plain.hot_pixels.sum() == 0
    assert 2 <= broken.hot_pixels.sum() <= 20
    assert np.abs(np.log(broken.pooled / plain.pooled)).max() < 0.05


def test_the_bootstrap_has_the_spread_of_a_poisson_process():
    """The deviation of a deviation from n / n^(1/3) blocks is a tenth here: three of them."""
    events = np.random.default_rng(0).poisson(50.0, (4000, 1, 2))
    made = contrast_threshold.EventRates(events, np.array([100]), np.array([0]), 0.01)
    spread = made.bootstrap_pooled_rates(1000).std(0) / made.pooled
    assert np.abs(spread * np.sqrt(4000 * 50) - 1).max() < 0.3


def test_the_interval_holds_the_draw_of_the_scene():
    """Scenes of one kind, whose contrast differs threefold: the recording shows one of them."""
    contrasts = np.random.default_rng(0).uniform(0.4, 1.2, 16)
    scenes = [0.45 + c * (scene(seed) - 0.45) for seed, c in enumerate(contrasts)]
    view, held, apart = np.zeros((48, 48), np.int64), 0, 0
    for index in range(8):
        pieces = recorded(EventSensor(0.2), [scenes[index]])
        measured = contrast_threshold.measure_event_rates(pieces, view, slices=40)
        found = contrast_threshold.estimate_contrast_threshold(
            measured, scenes[8:], FPS, EventSensor(), GRID
        )
        held += found.on[1] < 0.2 < found.on[2]
        apart += abs(np.log(found.on[0] / 0.2)) > 0.1
    assert apart >= 3
    assert held >= 7


@pytest.mark.parametrize("off_ratio", [1.0, 1.4])  # of the second OFF is beyond the grid itself
def test_intervals_end_where_the_grid_does_and_hold_their_value(off_ratio):
    contrasts = np.random.default_rng(0).uniform(0.4, 1.2, 6)
    scenes = [0.45 + c * (scene(seed) - 0.45) for seed, c in enumerate(contrasts)]
    pieces = recorded(EventSensor(0.7, off_ratio=off_ratio), [scenes[0]])
    measured = contrast_threshold.measure_event_rates(pieces, np.zeros((48, 48), int), slices=10)
    found = contrast_threshold.estimate_contrast_threshold(
        measured, scenes[1:], FPS, EventSensor(), GRID
    )
    for value, low, high in (found.on, found.off):
        assert min(GRID[0], value) <= low < high <= max(GRID[-1], value)
    assert GRID[-1] in found.on or GRID[0] in found.on


def test_hot_pixels_are_not_simulated():
    clips = [scene(0)]
    hot = EventSensor(hot_pixel_fraction=0.05, hot_pixel_hz=100.0)
    rates = [
        contrast_threshold.simulate_event_rates(clips, FPS, sensor, GRID).rates
        for sensor in (hot, EventSensor())
    ]
    assert np.allclose(*rates, rtol=1e-6)


def test_a_recording_of_one_polarity_is_named():
    [events] = recorded(EventSensor(0.2), [scene(0)])
    rising = events[events["p"] > 0]
    measured = contrast_threshold.measure_event_rates([rising], np.zeros((48, 48), np.int64))
    with pytest.raises(ValueError, match="must have ON and OFF events, got .* ON and 0 OFF"):
        contrast_threshold.require_both_polarities(measured)


def test_a_rate_that_no_threshold_makes_is_named():
    recording = recorded(EventSensor(0.2), [scene(0)])
    measured = contrast_threshold.measure_event_rates(
        recording, np.zeros((48, 48), np.int64), slices=10
    )
    with pytest.raises(ValueError, match="outside what the grid"):
        contrast_threshold.estimate_contrast_threshold(
            measured, [scene(1)], FPS, EventSensor(), [0.8, 1.0, 1.4]
        )


def test_a_recording_off_the_sensor_is_named():
    recording = recorded(EventSensor(0.2), [scene(0)])
    with pytest.raises(ValueError, match="outside the 40x48 sensor"):
        contrast_threshold.measure_event_rates(recording, np.zeros((48, 40), np.int64))


def test_figure_and_table_are_written_from_a_file(tmp_path):
    clips = [scene(0)]
    write_events(tmp_path / "a.raw", recorded(EventSensor(0.2), clips)[0], width=48, height=48)
    measured = contrast_threshold.measure_event_rates(
        open_recording(tmp_path / "a.raw"), np.zeros((48, 48), np.int64)
    )
    found = contrast_threshold.estimate_contrast_threshold(
        measured, clips, FPS, EventSensor(), GRID
    )
    calibration_figures.draw_event_rates(found, tmp_path / "threshold.png")
    contrast_threshold.write_threshold_csv(found, measured, tmp_path / "threshold.csv")
    assert (tmp_path / "threshold.png").stat().st_size > 5000
    assert "estimate,,0." in (tmp_path / "threshold.csv").read_text()
