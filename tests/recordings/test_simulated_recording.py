"""A simulated recording read back: its geometry, its motion and its turbulence are found again."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from src.recordings import sensor_lookup, simulated_recording, views
from src.recordings.calibration import view_alignment
from src.recordings.calibration.boards import Charuco, Checkerboard, Circles
from src.recordings.files import event_writers, recording, recording_inputs
from src.recordings.truth_file import create_truth_file
from src.recordings.turbulence_measurement import dot_statistics, gaussian_dots
from src.sim.optics import layout
from src.sim.sensor.sensor import EventSensor
from tests.recordings import pictures
from tests.recordings.test_views import distance_px, split
from tests.recordings.turbulence_measurement.test_dot_statistics import sampling_error, series

SENSOR, SIDE, TILE = (360, 364), 120, 116.0
VIEWS = [0, 1, 3, 4]  # mirrored both ways, in y, in x and not: the centre view
DOTS = [1, 4, 5]  # of 3 x 3: above, in and right of the middle


def noisy_sensor(**changes) -> EventSensor:
    settings = {
        "mismatch": 0.03,
        "dark_noise_hz": 1.0,
        "leak_event_hz": 0.1,
        "hot_pixel_fraction": 1e-4,
    }
    return EventSensor(0.4, refractory_s=5e-4, hot_pixel_hz=60.0, **{**settings, **changes})


@pytest.fixture(scope="module")
def truth() -> views.Views:
    positions = list(layout(9))
    return simulated_recording.kaleidoscope_views(
        positions, model=(SIDE, SIDE), sensor=SENSOR, tile_px=TILE, key=5
    )


def half(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(picture).reshape(SIDE, 2, SIDE, 2).mean((1, 3))


def blinking(picture: torch.Tensor, frames: int = 5) -> torch.Tensor:
    """Return (9, frames, h, w): a screen that shows the picture in every second frame."""
    film = torch.full((frames, *picture.shape), 0.05)
    film[1::2] = picture
    return film[None].expand(9, -1, -1, -1)


@pytest.mark.parametrize(
    "target, picture",
    [
        (Checkerboard(5, 7), pictures.checkerboard(5, 7, pitch=25)),
        (Circles(5, 7), pictures.circles(5, 7)),
    ],
    ids=["checkerboard", "circles"],
)
def test_a_blinking_screen_calibrates_the_views(truth, target, picture, tmp_path):
    path = tmp_path / "board.raw"
    simulated_recording.write_recording(path, blinking(half(picture)), 60.0, truth, noisy_sensor())
    seen = view_alignment.repair_picture(recording_inputs.read_picture_or_event_counts(path))
    aligned = view_alignment.fit_homographies(
        view_alignment.find_target_in_views(seen, target), sensor=SENSOR, model=(88, 88)
    )
    assert aligned.views.positions == list(layout(9))
    assert max(distance_px(aligned.views, truth).values()) < 0.3
    saved = views.load_views(tmp_path / "board.views.yaml", recording_inputs.find_sensor_size(path))
    assert [saved.mirrored_xy(view) for view in saved.views] == [
        aligned.views.mirrored_xy(view) for view in aligned.views.views
    ]


@pytest.mark.slow  # markers need the full sensor: 30 million events
def test_a_blinking_charuco_board_calibrates_the_views_of_an_evk4(tmp_path):
    truth = simulated_recording.kaleidoscope_views(list(layout(9)), model=(240, 240), key=5)
    film = blinking(torch.from_numpy(pictures.charuco()))
    events = simulated_recording.record_events(film, 60.0, truth, noisy_sensor())
    counts = np.zeros(truth.sensor)
    np.add.at(counts, (events["y"], events["x"]), 1)
    picture = view_alignment.repair_picture(counts)
    found = view_alignment.find_target_in_views(picture, Charuco(6, 6))
    with pytest.warns(UserWarning, match=r"points span little .*: view \(1, 1\) 5\d%; beyond"):
        aligned = view_alignment.fit_homographies(found, sensor=truth.sensor, model=(176, 176))
    away = distance_px(aligned.views, truth)
    assert away.pop((1, 1)) < 1.0 and max(away.values()) < 0.3  # markers of (1, 1) are missed


def moving_dot(frames: int = 41) -> tuple[torch.Tensor, np.ndarray]:
    """Return frames (frames, h, w) of a bright dot and its path (frames, 2)."""
    time = np.linspace(0, 1, frames)
    path = np.stack([25 + 70 * time, 80 - 40 * time], axis=1)
    film = pictures.dot_grid(
        path[:, None], np.full((frames, 1), 4.0), np.full((frames, 1), 0.8), SIDE
    )
    return torch.from_numpy(film).float() - 0.75, path


def test_every_view_shows_the_motion_upright_in_its_place(truth):
    film, path = moving_dot()
    clear = noisy_sensor(mismatch=0.0, dark_noise_hz=0.0, leak_event_hz=0.0, hot_pixel_fraction=0.0)
    events = simulated_recording.record_events(
        film[None].expand(9, -1, -1, -1).clamp(0, 1), 600.0, truth, clear
    )
    kept, view = split(sensor_lookup.build_lookup(truth), events)
    late = kept["t"] > 30_000
    for index in range(9):
        mine = kept[(view == index) & late & (kept["p"] > 0)]
        moment = mine["t"] * 600e-6
        there = [np.interp(moment, np.arange(len(path)), axis) for axis in path.T]
        lead = mine["x"] - there[0], mine["y"] - there[1]
        # ON events surround the leading edge, ahead of the dot by about its sigma of 4 px.
        assert 1 < np.mean(lead[0]) < 6 and -6 < np.mean(lead[1]) < -0.5


def test_bands_of_the_sensor_make_the_same_events(truth, monkeypatch):
    frames, sensor = blinking(half(pictures.circles(5, 7)), 3), noisy_sensor()
    whole = simulated_recording.record_events(frames, 60.0, truth, sensor)
    monkeypatch.setattr(simulated_recording, "BAND_BYTES", 4 * SENSOR[1] * 3 * 50)
    bands = simulated_recording.record_events(frames, 60.0, truth, sensor)
    one, other = (part[np.lexsort([part[name] for name in "pxyt"])] for part in (whole, bands))
    assert np.array_equal(one, other)
    assert (np.diff(bands["t"]) >= 0).all()


def test_timestamps_of_v2e_do_not_depend_on_the_memory_of_a_band(truth, monkeypatch):
    frames, sensor = blinking(half(pictures.circles(5, 7)), 3), noisy_sensor(stamps="v2e")
    whole = simulated_recording.record_events(frames, 60.0, truth, sensor)
    monkeypatch.setattr(simulated_recording, "BAND_BYTES", 4 * SENSOR[1] * 3 * 50)
    assert np.array_equal(whole, simulated_recording.record_events(frames, 60.0, truth, sensor))


def test_every_clip_has_noise_of_its_own(truth):
    still, noisy = torch.full((9, 9, SIDE, SIDE), 0.6), noisy_sensor(dark_noise_hz=5.0)
    one, again, other = (
        simulated_recording.record_events(still, 60.0, truth, noisy, key=key) for key in (1, 1, 2)
    )
    assert np.array_equal(one, again) and len(one) > 1000
    fields = ["t", "x", "y"]
    shared = set(one[fields].tolist()) & set(other[fields].tolist())
    assert len(shared) < 0.05 * len(one)


def test_a_still_scene_makes_no_event(truth):
    still = torch.full((9, 3, SIDE, SIDE), 0.6)
    ideal = EventSensor(0.2, refractory_s=0.0)
    assert len(simulated_recording.record_events(still, 60.0, truth, ideal)) == 0


@pytest.mark.parametrize("end", [*event_writers.BINARY, ".csv", ".npz", ".h5"])
def test_without_an_event_the_file_holds_none_and_one_warning_says_so(truth, tmp_path, end):
    still, ideal = torch.full((9, 3, SIDE, SIDE), 0.6), EventSensor(0.2, refractory_s=0.0)
    with pytest.warns(
        UserWarning, match=f"no events, .*a{end} holds none; sensor.threshold= "
    ) as w:
        simulated_recording.write_recording(tmp_path / f"a{end}", still, 60.0, truth, ideal)
    assert len(w) == 1 and len(recording.read_events(tmp_path / f"a{end}")) == 0
    assert views.load_views(tmp_path / "a.views.yaml").positions == truth.positions


def test_the_geometry_lies_beside_the_recording_and_the_truth_packs_what_is_seen(truth, tmp_path):
    frames, path = blinking(half(pictures.circles(5, 7)), 3), tmp_path / "cap.raw"
    events = simulated_recording.write_recording(path, frames, 60.0, truth, noisy_sensor())
    assert len(recording.read_events(path)) == len(events) > 0
    saved = views.load_views(tmp_path / "cap.views.yaml")
    assert saved.positions == truth.positions
    tilt = torch.linspace(-3, 3, 9 * 3 * 2 * SIDE * SIDE).reshape(9, 3, 2, SIDE, SIDE)
    with create_truth_file(path, truth, 3, 60.0, {"threshold": 0.4}) as file:
        for part in (slice(0, 2), slice(2, 3)):
            file.add(frames[0, part], frames[:, part], tilt[:, part])
    with h5py.File(tmp_path / "cap.truth.h5") as file:
        assert np.abs(file["clean"] - frames[0].numpy() * 255).max() <= 0.5001
        assert np.abs(file["views"] - frames.numpy() * 255).max() <= 0.5001
        assert np.abs(file["tilt"][:] - tilt.numpy()).max() <= 1 / 64
        assert file["positions"][:].tolist() == [list(p) for p in truth.positions]
        assert file.attrs["fps"] == 60 and np.allclose(file["time_s"], [0, 1 / 60, 2 / 60])


@pytest.mark.parametrize("shape, wide", [((180, 320), 23 / 24 * 240 * 16 / 9), ((256, 256), 230)])
def test_the_views_fill_the_sensor(shape, wide):
    found = simulated_recording.kaleidoscope_views(list(layout(9)), model=shape)
    assert found.field[2] - found.field[0] == pytest.approx(wide)


def test_views_turn_about_the_centre_one(truth):
    assert [truth.mirrored_xy(view) for view in truth.views] == [
        (bool(col % 2), bool(row % 2)) for row, col in layout(9)
    ]
    assert np.allclose(truth.views[4].homography, np.eye(3))


def dot_films(frames: int = 120) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    """Return dots (VIEWS, frames, h, w) with tilts (frames, 9 views x 9 dots, 2) and spreads."""
    grid = np.array([[x, y] for y in (30.0, 60.0, 90.0) for x in (30.0, 60.0, 90.0)])
    tilt = 0.8 * series(frames, 81, 0.7, seed=7).reshape(frames, 9, 9, 2)
    tilt[:, :, 1:] = 0.6 * tilt[:, :, :1] + 0.8 * tilt[:, :, 1:]  # within a view dots share a part
    sigma = 3.0 + 0.4 * np.random.default_rng(8).normal(size=(frames, 9, 9))
    dark = np.full((frames, 9), -0.6)
    films = [pictures.dot_grid(grid + tilt[:, v], sigma[:, v], dark, SIDE) for v in VIEWS]
    return torch.from_numpy(np.stack(films)).float(), tilt, sigma


def fits_of(films: torch.Tensor, truth: views.Views, places=None) -> tuple[list, np.ndarray]:
    """Film `VIEWS` on the sensor, register them again and fit `DOTS`."""
    truth = replace(truth, views=tuple(truth.views[v] for v in VIEWS))
    table = sensor_lookup.build_lookup(truth)
    seen = simulated_recording.render_sensor_frames(
        films, table, simulated_recording.vignette_gain(table, 0.3), slice(None)
    )
    seen = seen + 0.005 * torch.randn(seen.shape, generator=torch.Generator().manual_seed(0))
    registered = np.stack([truth.warp_to_model(frame) for frame in seen.numpy()], axis=1)
    if places is None:
        places = dot_statistics.find_dots(registered[VIEWS.index(4)].mean(0), 3, 3)[DOTS]
    return [gaussian_dots.fit_gaussians(view, places, 12) for view in registered], places


def test_statistics_are_those_of_the_simulated_turbulence(truth):
    films, tilt, sigma = dot_films()
    calm = pictures.dot_grid(
        np.array([[[x, y] for y in (30.0, 60.0, 90.0) for x in (30.0, 60.0, 90.0)]] * 6),
        np.full((6, 9), 2.4), np.full((6, 9), -0.6), SIDE,
    )  # fmt: skip
    still, places = fits_of(torch.from_numpy(calm).float()[None].expand(4, -1, -1, -1), truth)
    turbulent, _ = fits_of(films, truth, places)
    found = dot_statistics.compare_with_still(turbulent, still, fps=60.0, centre_view=3)
    assert found.failed.sum() == 0
    error = sampling_error(tilt[:, 4, 4])  # 0.09: of these 120 frames
    true = dot_statistics.autocorrelate(tilt[:, 4, 4], 20)
    assert np.abs(found.middle_dot_autocorrelation[:20] - true).max() < error
    centre = dot_statistics.tilt_correlation(tilt[:, 4, DOTS])
    assert np.abs(found.centre_view_correlation - centre).max() < error
    across = dot_statistics.tilt_correlation(tilt[:, VIEWS, 4])
    assert np.abs(found.tilt_correlation_across_views - across).max() < error
    assert found.blur_over_still[3] == pytest.approx(sigma[:, 4, DOTS].mean(0) / 2.4, rel=0.03)
    # The dots' flux goes as sigma squared here, which is what scintillation has to find.
    flux = sigma[:, 4, 4] ** 2
    index = flux.var() / flux.mean() ** 2
    assert found.scintillation[3, 1] == pytest.approx(index, rel=0.15)
    assert found.still_scintillation[3].max() < 0.1 * index
