"""Views found without a board: of simulated kaleidoscopes, whose geometry is known."""

import re
from functools import cache

import cv2
import numpy as np
import pytest
import torch

from src.recordings import simulated_recording
from src.recordings.calibration import activity_pictures, view_grid
from src.recordings.calibration.scene_alignment import SceneTarget, align_views_by_scene
from src.recordings.files.event_writers import write_events
from src.sim.optics import layout
from src.sim.sensor.sensor import EventSensor
from tests.recordings.test_views import distance_px, fold_corners

SENSOR, SIDE, TILE = (360, 640), 120, 116.0


def texture(seed: int, side: int = 2 * SIDE) -> np.ndarray:
    draws = np.random.default_rng(seed).standard_normal((3, side, side)).astype(np.float32)
    layers = [cv2.GaussianBlur(d, (0, 0), s) for d, s in zip(draws, (2, 5, 12), strict=True)]
    total = sum(layer / layer.std() for layer in layers)
    return (total - total.min()) / np.ptp(total)


def moving_scene(shift_px: float = 0.0, frames: int = 17) -> np.ndarray:
    """Return (frames, h, w): a texture that drifts and a disc that crosses it, nearer: it lies
    `shift_px` further right, as parallax has it."""
    ground, disc, film = texture(0), texture(1), []
    y, x = np.mgrid[:SIDE, :SIDE]
    for k in range(frames):
        drift = np.float32([[1, 0, -30 - 0.4 * k], [0, 1, -40 - 0.2 * k]])
        back = cv2.warpAffine(ground, drift, (SIDE, SIDE))
        near = np.float32([[1, 0, shift_px - 9 - k], [0, 1, -k]])
        front = cv2.warpAffine(disc, near, (SIDE, SIDE))
        inside = np.hypot(x - 20 - 4 * k - shift_px, y - 60 + k) < 20
        film.append(np.where(inside, front, back))
    return 0.9 * np.stack(film) + 0.05


def record(path, positions, films, key: int = 5, angle_rad: float = 0.0, leak_hz: float = 0.0):
    truth = simulated_recording.kaleidoscope_views(
        list(positions), model=(SIDE, SIDE), sensor=SENSOR, tile_px=TILE, key=key
    )
    truth = fold_corners(truth, angle_rad, off_px=8.0) if angle_rad else truth
    sensor = EventSensor(
        0.3, refractory_s=5e-4, mismatch=0.03, dark_noise_hz=1.0, leak_event_hz=leak_hz,
        hot_pixel_fraction=1e-4, hot_pixel_hz=60.0,
    )  # fmt: skip
    frames = torch.from_numpy(np.stack(films)).float().expand(len(positions), -1, -1, -1)
    events = simulated_recording.record_events(frames, 300.0, truth, sensor)
    write_events(path, events, width=SENSOR[1], height=SENSOR[0])
    return truth


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a function of a number of views: their truth, and pictures of a recording of them."""

    @cache
    def once(views: int):
        path = tmp_path_factory.mktemp("kaleidoscope") / "scene.raw"
        truth = record(path, layout(views), [moving_scene()], key=views)
        return truth, activity_pictures.read_activity_pictures(path)

    return once


@pytest.mark.parametrize(
    "views",
    [
        pytest.param(3, id="1x3"),
        pytest.param(4, id="2x2"),
        pytest.param(9, id="3x3", marks=pytest.mark.slow),
    ],
)
def test_any_scene_finds_the_views_of_a_kaleidoscope(views, recorded):
    truth, pictures = recorded(views)
    found = align_views_by_scene(pictures, SceneTarget(), (88, 88))
    there = found.aligned.views
    assert there.positions == list(layout(views))
    assert max(distance_px(there, truth).values()) < 0.3
    assert max(found.held_out_px.values()) < 0.3 and min(found.matched.values()) > 0.9
    assert not any(view.fold for view in there.views)
    assert [there.mirrored_xy(v) for v in there.views] == [
        (bool(col % 2), bool(row % 2)) for row, col in layout(views)
    ]
    left, top, right, bottom = np.array(there.field) - truth.field
    assert min(left, top, -right, -bottom) > -6 and max(left, top, -right, -bottom) < 16


def test_leak_leaves_the_views_in_place(tmp_path):
    """References anywhere between two thresholds blur the pictures of events: the field is smaller,
    the error of held-out points larger, the views where they are."""
    truth = record(tmp_path / "a.raw", layout(3), [moving_scene()], key=3, leak_hz=0.1)
    pictures = activity_pictures.read_activity_pictures(tmp_path / "a.raw")
    found = align_views_by_scene(pictures, SceneTarget(), (88, 88))
    assert max(distance_px(found.aligned.views, truth).values()) < 0.3
    assert max(found.held_out_px.values()) < 0.5


@pytest.mark.parametrize("window", [0, 9])
def test_a_short_pass_in_a_long_recording_with_noise(recorded, window):
    truth, seen = recorded(3)
    short_pass = seen.sum(0)
    noise = np.random.default_rng(0).poisson(0.002, (16, *short_pass.shape))  # in 80 ms, 0.05 Hz
    pictures = noise.astype(np.float32)
    pictures[window] += short_pass
    assert len(activity_pictures.keep_windows_with_motion(pictures)) == 1
    found = align_views_by_scene(pictures, SceneTarget(), (88, 88))
    assert found.aligned.views.positions == list(layout(3)) and not found.held_out_px
    assert max(distance_px(found.aligned.views, truth).values()) < 0.3


def test_windows_of_noise_alone_are_refused():
    noise = np.random.default_rng(0).poisson(0.01, (4, 2, 180, 320)).astype(np.float32)
    assert len(activity_pictures.keep_windows_with_motion(np.zeros_like(noise))) == 4
    with pytest.raises(ValueError, match="as windows without any do not help"):
        align_views_by_scene(noise, SceneTarget(), (88, 88))


@pytest.mark.parametrize(
    "views",
    [pytest.param(4, id="2x2"), pytest.param(9, id="3x3", marks=pytest.mark.slow)],
)
def test_mirrors_off_the_right_angle_give_corner_views_in_halves(views, tmp_path):
    path = tmp_path / "scene.raw"
    truth = record(path, layout(views), [moving_scene()], key=9, angle_rad=0.03)
    pictures = activity_pictures.read_activity_pictures(path)
    found = align_views_by_scene(pictures, SceneTarget(), (88, 88))
    there = found.aligned.views
    assert re.search(r"halves 1\.[5-9] degrees apart", found.summary()["view (1, 1)"])
    assert max(distance_px(there, truth).values()) < 0.3
    for view, true in zip(there.views, truth.views, strict=True):
        assert (view.fold is None) == (true.fold is None)
        if view.fold:
            assert view.fold.angle_rad == pytest.approx(true.fold.angle_rad, abs=0.004)
            assert np.abs(np.subtract(view.fold.corner, true.fold.corner)).max() < 3


def test_a_folder_of_frames_finds_them_too(tmp_path):
    truth = simulated_recording.kaleidoscope_views(
        list(layout(9)), model=(SIDE, SIDE), sensor=(352, 364), tile_px=TILE, key=2
    )
    lookup = simulated_recording.build_lookup(truth)
    light = (lookup.view >= 0).astype(np.float32)
    frames = torch.from_numpy(moving_scene(frames=2)).float().expand(9, -1, -1, -1)
    seen = simulated_recording.render_sensor_frames(frames, lookup, light, slice(None))
    for index, frame in enumerate(seen.numpy()):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.round(255 * frame))
    pictures = activity_pictures.read_activity_pictures(tmp_path)
    assert pictures.shape == (2, 1, 352, 364)
    assert abs(pictures[1, 0] - 255 * seen[1].numpy()).max() < 1
    there = align_views_by_scene(pictures, SceneTarget(), (88, 88)).aligned.views
    assert there.positions == list(layout(9))
    assert max(distance_px(there, truth).values()) < 0.5  # dark gaps at the seams disturb


def test_views_of_another_place_or_with_parallax_are_refused(tmp_path):
    films = [moving_scene() for _ in range(9)]
    films[8] = films[8][:, ::-1]
    path = tmp_path / "scene.raw"
    record(path, layout(9), films)
    pictures = activity_pictures.read_activity_pictures(path)
    with pytest.raises(ValueError, match=r"view \(1, 1\) (matches at|shows)"):
        align_views_by_scene(pictures, SceneTarget(), (88, 88))


def test_a_scene_without_repetition_or_events_is_refused():
    once = np.stack([texture(k, 160) for k in range(2)])[:, None] * 50
    with pytest.raises(
        ValueError, match="must show mirrored views side by side.*turned by more than"
    ):
        align_views_by_scene(once, SceneTarget(), (88, 88))
    with pytest.raises(ValueError, match=r"share 0\.00 of what they show"):
        align_views_by_scene(np.zeros((1, 2, 90, 120), np.float32), SceneTarget(), (88, 88))


def test_the_views_at_the_borders_are_left_out():
    tile = texture(3, 56)
    row = np.concatenate([tile[:, ::-1], tile, tile[:, ::-1], tile], axis=1)
    whole = np.concatenate([row[::-1], row, row[::-1]])[21:, 7:-22]
    grid = view_grid.find_grid(200 * whole[None, None])
    assert grid.positions == [(row, col) for row in (0, 1) for col in (0, 1)]
    assert np.abs(np.subtract(grid.centre_view_edges, (48.5, 34.5, 104.5, 90.5))).max() < 3


def test_windows_share_a_recording_of_any_length():
    sums = activity_pictures.DoublingWindowSums((1,), 5)
    for time in range(0, 1000, 5):
        sums.add(time, np.ones(1))
    assert sums.length == 80 and [float(window[0]) for window in sums.windows] == [16.0] * 12 + [
        8.0
    ]


@pytest.mark.parametrize("wrong", [{"error_px": 0}, {"error_px": 11}, {"min_matched": 0}])
def test_a_setting_out_of_range_is_refused(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=rf"target\.{name} must be in"):
        SceneTarget(**wrong)
