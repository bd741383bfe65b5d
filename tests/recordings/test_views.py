"""The calibration finds what the simulated kaleidoscope is; the lookup splits without loss."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from src.recordings import sensor_lookup, simulated_recording, views
from src.recordings.calibration import view_alignment
from src.recordings.calibration.boards import Charuco, Checkerboard, Circles
from src.recordings.corner_fold import CornerFold
from src.recordings.files.event_file import EVENT
from src.sim.optics import layout
from src.sim.voxel import voxel_grid
from tests.recordings import pictures

SENSOR, SIDE = (720, 1280), pictures.SIDE
TARGETS = {
    "checkerboard": (Checkerboard(5, 7), pictures.checkerboard(5, 7)),
    "square checkerboard": (Checkerboard(6, 6), pictures.checkerboard(6, 6, angle=-0.08)),
    "circles": (Circles(5, 7), pictures.circles(5, 7)),
    "charuco": (Charuco(6, 6), pictures.charuco()),
}


@pytest.fixture(scope="module")
def truth() -> views.Views:
    return simulated_recording.kaleidoscope_views(
        list(layout(9)), model=(SIDE, SIDE), sensor=SENSOR, key=3
    )


@cache
def lookup_of(there: views.Views) -> sensor_lookup.SensorLookup:
    return sensor_lookup.build_lookup(there)


def fold_corners(truth: views.Views, angle_rad: float, off_px: float = 0.0) -> views.Views:
    """Return the views with corner views in halves, whose lines cross `off_px` right of and half
    as far above the middle of the field."""
    left, top, right, bottom = truth.field
    towards = (left + right) / 2 + off_px, (top + bottom - off_px) / 2
    turned = []
    for view in truth.views:
        row, col = view.position
        corner = right if col > 0 else left, bottom if row > 0 else top
        fold = CornerFold(corner, towards, angle_rad * col)  # right apart, left over each other
        turned.append(replace(view, fold=fold) if row and col else view)
    return replace(truth, views=tuple(turned))


def shown(
    truth: views.Views, picture: np.ndarray, keep=range(9), noise: float = 0.02
) -> np.ndarray:
    """Return what the sensor sees (uint8) when the views `keep` show `picture`."""
    frames = torch.zeros(9, 1, *picture.shape)
    frames[list(keep)] = torch.from_numpy(picture)
    table = lookup_of(truth)
    seen = simulated_recording.render_sensor_frames(
        frames, table, simulated_recording.vignette_gain(table), slice(None)
    )[0].numpy()
    seen = seen + np.random.default_rng(0).normal(0, noise, seen.shape)
    return np.clip(seen * 255, 0, 255).astype(np.uint8)


def distance_px(found: views.Views, truth: views.Views) -> dict:
    """Return the mean distance over the field between the true and the found place of a pixel."""
    true = {view.position: view for view in truth.views}
    left, top, right, bottom = found.field
    field = views.list_grid_points(np.linspace(left, right, 9), np.linspace(top, bottom, 9))
    far = {}
    for view in found.views:
        offset = view.to_centre(true[view.position].to_sensor(field)) - field
        far[view.position] = np.linalg.norm(offset, axis=1).mean()
    return far


def calibrate(picture, target, **options):
    found = view_alignment.find_target_in_views(picture, target, **options)
    return view_alignment.fit_homographies(found, sensor=SENSOR, model=(176, 176)).views


@pytest.fixture(scope="module")
def found_by(truth):
    """Return a function of the name of a target: the views found by it."""

    @cache
    def once(name: str) -> views.Views:
        target, picture = TARGETS[name]
        return calibrate(shown(truth, picture), target)

    return once


@pytest.mark.parametrize("name", TARGETS)
def test_homographies_within_a_third_of_a_pixel_and_flips_right(truth, found_by, name):
    found = found_by(name)
    assert found.positions == list(layout(9))
    assert max(distance_px(found, truth).values()) < 0.3
    for mine, true in zip(found.views, truth.views, strict=True):
        assert found.mirrored_xy(mine) == truth.mirrored_xy(true)
        odd = sum(mine.position) % 2
        assert np.sign(np.linalg.det(mine.homography)) == (-1 if odd else 1)


def test_field_is_the_centre_tile_less_its_margin(truth, found_by):
    found = found_by("checkerboard")
    left, top, right, bottom = truth.field
    expected = np.array([left, top, right, bottom]) + 0.04 * (right - left) * np.array(
        [1, 1, -1, -1]
    )
    assert np.abs(np.array(found.field) - expected).max() < 4  # misaligned by 3 px a corner


def test_charuco_finds_unmirrored_views_by_itself(truth):
    target, picture = TARGETS["charuco"]
    found = calibrate(shown(truth, picture), target, are_mirrored=False)
    assert max(distance_px(found, truth).values()) < 0.3


def test_a_view_that_does_not_show_the_target_is_left_out(truth):
    target, picture = TARGETS["circles"]
    found = calibrate(shown(truth, picture, keep=[0, 1, 3, 4, 5]), target)
    assert found.positions == [(-1, -1), (-1, 0), (0, -1), (0, 0), (0, 1)]
    assert max(distance_px(found, truth).values()) < 0.3


def test_fewer_than_four_views_are_refused_but_reported(truth):
    target, picture = TARGETS["circles"]
    found = view_alignment.find_target_in_views(shown(truth, picture, keep=[3, 4, 5]), target)
    assert sorted(found) == [(0, -1), (0, 0), (0, 1)]
    with pytest.raises(ValueError, match="in 4 or more views .* got 3"):
        view_alignment.fit_homographies(found, sensor=SENSOR, model=(176, 176))


def test_a_picture_without_targets_shows_none():
    noise = np.random.default_rng(0).integers(0, 255, SENSOR).astype(np.uint8)
    assert not view_alignment.find_target_in_views(noise, Circles(5, 7))


def test_corners_by_hand_give_the_true_homographies(truth):
    corners = {view.position: truth.outline(view) for view in truth.views}
    by_hand = view_alignment.views_from_corners(corners, sensor=SENSOR, model=(176, 176))
    assert max(distance_px(by_hand, truth).values()) < 0.01


def test_file_comes_back_exactly(truth, tmp_path):
    truth.save(tmp_path / "views.yaml")
    back = views.load_views(tmp_path / "views.yaml", SENSOR)
    assert (back.sensor, back.model, back.field) == (truth.sensor, truth.model, truth.field)
    for mine, true in zip(back.views, truth.views, strict=True):
        assert np.array_equal(mine.homography, true.homography)
    assert not list(tmp_path.glob("views.yaml?*"))
    folded = fold_corners(truth, 0.02)
    folded.save(tmp_path / "views.yaml")
    back = views.load_views(tmp_path / "views.yaml", SENSOR)
    assert [view.fold for view in back.views] == [view.fold for view in folded.views]
    assert sum(view.fold is not None for view in back.views) == 4


@pytest.mark.parametrize(
    "change, message",
    [
        ((r"sensor: \[720, 1280\]", "sensor: [480, 640]"), "lie on the 640x480 sensor"),
        ((r"mirrored: \[true", "mirrored: [false"), "contradicts"),
        ((r"model: \[240", "model: [2400000"), "views.model must be in"),
        ((r"model: \[240, 240\]", "model: [240]"), "yaml: expected a list of 2 x int"),
        ((r"position: \[-1, -1\]", "position: [0, 0]"), "different positions"),
        ((r"\nfield: \[", "\nfield: [.nan, "), "yaml: expected a list of 4 x float"),
        ((r"  - \[[^,]+", "  - [.inf"), "finite and regular"),
        (("views:", "windows:"), "yaml: no entry views"),
        ((r"  homography:", "  matrix:"), "yaml: no entry homography"),
        (("sensor:", "{ sensor:"), "must be a file of calibrate"),
    ],
)
def test_a_spoilt_file_is_refused_in_one_line(truth, tmp_path, change, message):
    path = tmp_path / "views.yaml"
    truth.save(path)
    text, count = re.subn(*change, path.read_text(), count=1)
    assert count == 1
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        views.load_views(path)


@pytest.mark.parametrize(
    "change, message",
    [
        (("angle_rad: [^\n]*", "angle_rad: 0.4"), r"angle_rad must be in -0\.3\.\.0\.3, got 0\.4"),
        (("angle_rad: [^\n]*", "angle_rad: .nan"), "fold must be finite"),
        (("    corner: [^\n]*\n", ""), "yaml: no entry corner"),
    ],
)
def test_a_spoilt_fold_is_refused_in_one_line(truth, tmp_path, change, message):
    path = tmp_path / "views.yaml"
    fold_corners(truth, 0.02).save(path)
    path.write_text(re.sub(*change, path.read_text(), count=1))
    with pytest.raises(ValueError, match=message):
        views.load_views(path)


@pytest.mark.parametrize("angle", [0.1, -0.1])
def test_the_halves_of_a_corner_view_are_turned_apart_or_over_each_other(angle):
    fold = CornerFold((100.0, 50.0), (0.0, 50.0), angle)  # the line runs left from the corner
    seen = fold.turn_halves(np.array([[0.0, 50.5], [0.0, 49.5], [100.0, 50.0]]))
    assert np.allclose(seen[2], fold.corner) and seen[0, 0] == pytest.approx(seen[1, 0])
    apart = np.cos(angle / 2) + 200 * np.sin(angle / 2)
    assert seen[0, 1] - seen[1, 1] == pytest.approx(apart)
    away = np.array([[0.0, 70.0], [0.0, 30.0], [60.0, 90.0]])
    assert np.allclose(fold.turn_halves(fold.turn_halves_back(away)), away)


def test_lookup_and_registration_follow_the_halves(truth):
    folded, picture = fold_corners(truth, 0.03), pictures.circles(5, 7)
    table = lookup_of(folded)
    y, x = np.nonzero(table.view == 8)
    expected = folded.to_model(folded.views[8], np.stack([x, y], axis=1).astype(float))
    plain = truth.to_model(truth.views[8], np.stack([x, y], axis=1).astype(float))
    assert np.abs(table.model_xy[y, x] - expected).max() < 1e-3
    assert 1 < np.linalg.norm(expected - plain, axis=1).mean() < 3  # 0.015 rad at 100 px
    seen = shown(folded, picture, noise=0.0) / 255.0
    registered = folded.warp_to_model(seen)
    inner = np.s_[60:-60, 60:-60]
    likeness = [
        np.corrcoef(view[inner].ravel(), picture[inner].ravel())[0, 1] for view in registered
    ]
    assert min(likeness) > 0.95
    unaware = replace(truth, views=truth.views[8:]).warp_to_model(seen)[0]
    assert np.corrcoef(unaware[inner].ravel(), picture[inner].ravel())[0, 1] < min(likeness)


@pytest.mark.parametrize(
    "text, fault",
    [
        ("", "no entry views"), ("words", "no entry views"), ("- 1", "no entry views"),
        ("views: 5", "expected a list of views"),
        ("{sensor: [9, 9], model: [9, 9], field: [0, 0, 9, 9], views: [1]}", "no entry homography"),
    ],
)  # fmt: skip
def test_another_yaml_file_is_refused_for_what_it_lacks(tmp_path, text, fault):
    (tmp_path / "a.yaml").write_text(text)
    wanted = f"^views must be a file of calibrate task=views, got .*a.yaml: {fault}$"
    with pytest.raises(ValueError, match=wanted):
        views.load_views(tmp_path / "a.yaml")


def test_views_of_another_sensor_are_refused(truth, tmp_path):
    truth.save(tmp_path / "views.yaml")
    with pytest.raises(ValueError, match="must be the recording's"):
        views.load_views(tmp_path / "views.yaml", (480, 640))


def test_views_are_in_order_of_position(truth, tmp_path):
    path = tmp_path / "views.yaml"
    replace(truth, views=truth.views[::-1]).save(path)
    assert [view.position for view in views.load_views(path).views] == sorted(truth.positions)


def test_an_absent_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match="got .*none.yaml: No such file or directory$"):
        views.load_views(tmp_path / "none.yaml")


def stream(count: int, sensor=SENSOR, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    events = np.zeros(count, EVENT)
    events["t"] = np.sort(rng.integers(0, 10_000, count))
    events["x"], events["y"] = rng.integers(0, sensor[1], count), rng.integers(0, sensor[0], count)
    events["p"] = rng.choice([-1, 1], count)
    return events


@pytest.mark.parametrize("nearest", [False, True])
def test_splitting_keeps_the_mass_of_each_view_and_counts_the_rest(truth, nearest):
    table, events = lookup_of(truth), stream(50_000)
    grid = table.empty_grid(5)
    outside = table.add_to_grid(events, grid, 0, 10_000, nearest=nearest)
    view = table.view[events["y"], events["x"]]
    assert outside == (view < 0).sum() > 0
    for index in range(9):
        assert grid[index].sum() == pytest.approx(events["p"][view == index].sum(), abs=1e-2)


@pytest.mark.parametrize("kind", ["bilinear", "nearest"])
def test_an_event_of_every_pixel_is_flat_per_sensor_pixel(truth, kind):
    there = views.Views(truth.sensor, (176, 176), truth.field, truth.views)
    table = sensor_lookup.build_lookup(there)
    events = np.zeros(SENSOR[0] * SENSOR[1], EVENT)
    events["y"], events["x"] = np.indices(SENSOR).reshape(2, -1)
    events["p"] = 1
    grid = table.empty_grid(1)
    table.add_to_grid(events, grid, 0, 1, nearest=kind == "nearest")
    inner = (slice(None), 0, slice(4, -4), slice(4, -4))
    assert grid[inner].mean() == pytest.approx((230 / 176) ** 2, rel=0.03)
    assert grid[inner].std() > 0.1  # it ripples
    assert np.abs((grid / table.density[kind])[inner] - 1).max() < 1e-5


def split(table: sensor_lookup.SensorLookup, events: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the events inside views, at their nearest model pixel, and the view of each."""
    pixel = table.nearest_model_pixel[events["y"], events["x"]]
    kept = events[pixel >= 0].copy()
    view, kept["y"], kept["x"] = np.unravel_index(pixel[pixel >= 0], (table.views, *table.model))
    return kept, view


def test_nearest_splat_is_the_voxel_grid_of_each_views_events(truth):
    table, events = lookup_of(truth), stream(50_000)
    grid = table.empty_grid(5)
    table.add_to_grid(events, grid, 0, 10_000, nearest=True)
    kept, view = split(table, events)
    for index in range(9):
        mine = kept[view == index]
        fields = (mine[name] for name in "txyp")
        expected = voxel_grid(*fields, t0=0, t1=10_000, bins=5, height=SIDE, width=SIDE)
        assert np.abs(grid[index] - expected.numpy()).max() < 1e-4


def test_bilinear_splat_is_a_hat_around_each_place(truth):
    table, event = lookup_of(truth), stream(1)
    event["x"], event["y"], event["t"], event["p"] = 700, 380, 2500, -1
    grid = table.empty_grid(5)
    table.add_to_grid(event, grid, 0, 10_000)
    u, v = table.model_xy[380, 700]
    x, y = np.arange(SIDE), np.arange(SIDE)[:, None]
    hat = np.clip(1 - abs(x - u), 0, None) * np.clip(1 - abs(y - v), 0, None)
    assert np.abs(grid[4, 1] + hat).max() < 1e-5  # 2500 us is the place of bin 1 of 5
    assert np.abs(grid[4, [0, 2, 3, 4]]).max() < 1e-5


def test_one_view_at_sensor_size_is_the_plain_voxel_grid():
    events = stream(5000, (60, 80))
    table = sensor_lookup.build_lookup(views.Views.single_view((60, 80), (60, 80)))
    grid = table.empty_grid(3)
    assert table.add_to_grid(events, grid, 0, 10_000) == 0
    fields = (events[name] for name in "txyp")
    expected = voxel_grid(*fields, t0=0, t1=10_000, bins=3, height=60, width=80)
    assert np.abs(grid[0] - expected.numpy()).max() < 1e-5


def test_an_event_off_the_sensor_is_refused(truth):
    table, events = lookup_of(truth), stream(10)
    events["x"][3] = 1280
    with pytest.raises(ValueError, match="1280x720 sensor"):
        table.add_to_grid(events, table.empty_grid(5), 0, 10_000)


def test_registered_views_agree_with_the_scene(truth):
    picture = pictures.circles(5, 7)
    registered = truth.warp_to_model(shown(truth, picture, noise=0.0) / 255.0)
    inner = (slice(None), slice(60, -60), slice(60, -60))
    assert np.corrcoef(registered[inner].mean(0).ravel(), picture[inner[1:]].ravel())[0, 1] > 0.98


def test_pictures_of_another_sensor_are_refused():
    whole = views.Views.single_view((48, 64), (24, 32))
    assert whole.warp_to_model(np.zeros((48, 64))).shape == (1, 24, 32)
    with pytest.raises(
        ValueError, match="must be of a sensor of 64x32, as the pictures, got 64x48"
    ):
        whole.warp_to_model(np.zeros((32, 64)))


@pytest.mark.parametrize("resolution", [(100_000, 10), (8000, 8000)])
def test_a_resolution_that_is_too_large_is_named(resolution):
    with pytest.raises(ValueError, match="^resolution must "):
        views.views_or_whole_sensor(None, (48, 64), resolution)
    with pytest.raises(ValueError, match="^sensor_size must .* got .100000, 10.$|, 8000.$"):
        views.views_or_whole_sensor(None, resolution)
