"""From a simulated recording to views.yaml to video to statistics, through the entry points."""

import csv
import dataclasses
import re
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from src.app import simulation
from src.calibrate import TASKS, calibrate, describe_resolution
from src.compare import compare, default_video_names
from src.figures import comparison
from src.live import build_server
from src.models.files import load
from src.reconstruct import (
    describe_playback,
    describe_run,
    reconstruct,
    show_progress,
    suggest_faster_form,
)
from src.recordings import reconstruction, sensor_lookup, simulated_recording, truth_file, views
from src.recordings.calibration import contrast_threshold
from src.recordings.files import read_events
from src.sim.optics import layout
from src.sim.sensor.sensor import EventSensor
from tests.conftest import ROOT
from tests.recordings import pictures

SENSOR, SIDE = (360, 640), 120
HIGHPASS = "+baseline._target_=baselines.highpass.HighPass"


def config(name: str, run: Path, *overrides: str):
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        cfg = compose(name, list(overrides))
    run.mkdir(exist_ok=True)
    cfg.paths.run = str(run)
    return cfg


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with board.raw, a blinking board, dot.raw, a moving dot, and dot.npz, the
    same without the sensor's size."""
    folder = tmp_path_factory.mktemp("camera")
    truth = simulated_recording.kaleidoscope_views(
        list(layout(9)), model=(SIDE, SIDE), sensor=SENSOR, tile_px=116.0
    )
    sensor = EventSensor(0.5, refractory_s=5e-4, dark_noise_hz=0.5)
    board = torch.from_numpy(pictures.checkerboard(5, 7, 25)).reshape(SIDE, 2, SIDE, 2).mean((1, 3))
    blink = torch.stack([board if k % 2 else torch.full_like(board, 0.05) for k in range(5)])
    path = np.stack([np.linspace(30, 90, 31), np.linspace(80, 50, 31)], axis=1)
    dot = pictures.dot_grid(path[:, None], np.full((31, 1), 4.0), np.full((31, 1), 0.9), SIDE) - 0.7
    for name, film in (("board", blink), ("dot", torch.from_numpy(dot).float().clamp(0, 1))):
        frames = film[None].expand(9, -1, -1, -1)
        simulated_recording.write_recording(folder / f"{name}.raw", frames, 300.0, truth, sensor)
    events = read_events(folder / "dot.raw")
    np.savez(folder / "dot.npz", **{name: events[name] for name in "txyp"})
    return folder


@pytest.fixture(scope="module")
def found(folder) -> Path:
    """Return the views.yaml that src.calibrate made of board.raw."""
    path = folder / "views.yaml"
    recording = f"recording={folder}/board.raw"
    calibrate(
        config(
            "calibrate", folder / "a", "task=views", recording, f"save={path}", "resolution=[88,88]"
        )
    )
    return path


def test_calibrating_the_views_leaves_a_file_and_pictures(folder, found):
    there = views.load_views(found, SENSOR)
    assert there.positions == list(layout(9)) and there.model == (88, 88)
    assert max(view.error_px for view in there.views) < 0.5
    for name in ("views.yaml", "views.png", "found.png"):
        assert (folder / "a" / name).stat().st_size > 0


@pytest.mark.parametrize("extra", ["fps=120", "fps=1200", "fps=300 start_s=0.02 end_s=0.06"])
def test_reconstructing_gives_a_picture_and_a_time_per_window(folder, found, extra, tmp_path):
    chosen = [f"recording={folder}/dot.raw", f"views={found}", HIGHPASS, "output_format=hdf5"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen, *extra.split()))
    with h5py.File(run / "video.h5") as file:
        frames, times = file["frames"][:], file["time_s"][:]
    assert frames.shape[1:] == (88, 88) and len(frames) == len(times) > 5
    assert (np.diff(times) > 0).all() and frames.std() > 1
    with open(run / "frames.csv") as file:
        assert len(list(csv.DictReader(file))) == len(frames)


def test_a_stopped_run_leaves_the_video_before_with_its_config(
    folder, found, tmp_path, monkeypatch
):
    chosen = [f"recording={folder}/dot.raw", f"views={found}", HIGHPASS, "output_format=hdf5"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen, "fps=120"))
    whole = {path.name: path.read_bytes() for path in run.iterdir()}

    def stop(frames, first_s):
        yield next(iter(frames))
        raise KeyboardInterrupt

    monkeypatch.setattr("src.reconstruct.show_progress", stop)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(config("reconstruct", run, *chosen, "fps=240"))
    assert {name: (run / name).read_bytes() for name in whole} == whole
    left = sorted(path.name for path in run.iterdir() if path.name not in whole)
    assert left == ["config.partial.yaml", "frames.partial.csv", "video.partial.h5"]


def test_a_faster_form_gives_nearly_the_same_frames(folder, found, tmp_path):
    chosen = [
        f"recording={folder}/dot.raw",
        f"views={found}",
        "ckpt=setnet_small",
        "output_format=hdf5",
    ]
    shown = []
    for form in ("float32", "bf16"):
        reconstruct(config("reconstruct", tmp_path / form, *chosen, f"form={form}"))
        with h5py.File(tmp_path / form / "video.h5") as file:
            shown.append(file["frames"][:].astype(float) / 255)
    assert 0 < np.abs(shown[0] - shown[1]).mean() < 0.02


def test_what_a_backward_warmup_adds_is_there_from_the_first_frame_and_fades(
    folder, found, tmp_path
):
    chosen = [f"recording={folder}/dot.raw", f"views={found}", HIGHPASS, "output_format=hdf5"]
    films = []
    for ahead in (0.0, 0.1):
        run = tmp_path / str(ahead)
        reconstruct(config("reconstruct", run, *chosen, f"backward_warmup_s={ahead}"))
        with h5py.File(run / "video.h5") as file:
            films.append(file["frames"][:].astype(float))
    added = np.abs(films[1] - films[0]).mean((1, 2))
    assert added[0] > 0.1 and added[-1] < 0.5 * added[0]


def test_the_reconstructed_dot_moves_as_the_true_one(folder, found, tmp_path):
    chosen = [
        f"recording={folder}/dot.raw",
        f"views={found}",
        HIGHPASS,
        "output_format=hdf5",
        "fps=300",
    ]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen))
    with h5py.File(run / "video.h5") as file:
        bright = np.clip(file["frames"][:].astype(float) - 140, 0, None)
    x = (bright.sum(1) @ np.arange(88)) / bright.sum((1, 2))
    assert np.corrcoef(x[5:], np.arange(len(x) - 5))[0, 1] > 0.99


@pytest.mark.parametrize("toning", ["none", "auto"])
def test_a_film_shows_events_one_view_all_views_and_the_clean_clip(
    folder, found, tmp_path, capsys, toning
):
    (tmp_path / "dot.raw").symlink_to(folder / "dot.raw")
    truth = views.load_views(found)
    with truth_file.create_truth_file(tmp_path / "dot.raw", truth, 31, 300.0, {}) as file:
        clean = torch.linspace(0, 1, 31)[:, None, None].expand(31, 88, 88)
        file.add(clean, clean.expand(9, -1, -1, -1), torch.zeros(9, 31, 2, 88, 88))
    chosen = [f"recording={tmp_path}/dot.raw", f"views={found}", "ckpt=setnet_small", "fps=300"]
    chosen += ["output_format=film", "end_s=0.05", f"tone={toning}"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen))
    file, frames = cv2.VideoCapture(str(run / "film.mp4")), []
    while (read := file.read())[0]:
        frames.append(read[1])
    assert len(frames) == 15 and frames[0].shape == (106, 4 * 88 + 3 * 4, 3)
    panels = [np.stack(frames)[:, 20:, 92 * k : 92 * k + 88].astype(float) for k in range(4)]
    shown = panels[3].mean((1, 2, 3)) / 255
    assert np.allclose(shown, (np.arange(15) + 1) / 30, atol=0.04)  # the frame at the window's end
    assert panels[0].mean() > 200 and np.ptp(panels[0][..., 0] - panels[0][..., 2]) > 50  # colours
    assert [np.ptp(panel[5:]) > 230 for panel in panels[1:3]] == [toning == "auto"] * 2
    assert np.abs(panels[1] - panels[2]).mean() > 0.5  # one view is not nine
    (line,) = [one for one in capsys.readouterr().out.splitlines() if "film.mp4" in one]
    assert line.startswith(f"{run}/film.mp4: 15 frames, 364x106 px, 9 views; ")
    assert re.search(r", after the first frame \d+\.\d frames per second of wall time, read", line)
    assert "; shown at playback_fps=30, " in line


def test_what_a_run_replaces_is_said_and_no_frame_of_it_stays(folder, tmp_path, capsys):
    (tmp_path / "run" / "frames").mkdir(parents=True)
    for number in range(60):
        (tmp_path / "run" / "frames" / f"{number:07d}.png").touch()
    chosen = [f"recording={folder}/dot.raw", HIGHPASS, "output_format=png", "resolution=[90,160]"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen))
    said = capsys.readouterr().out
    assert f"{run}/frames, 60 files, is there and will be replaced\n" in said
    assert 0 < len(list((run / "frames").iterdir())) < 60
    reconstruct(config("reconstruct", run, *chosen, "output_format=hdf5"))
    lines = capsys.readouterr().out.splitlines()[:2]
    kept = f"{run} keeps frames of an earlier run; frames.csv and config.yaml will be of video.h5"
    assert lines == [f"{run}/frames.csv is there and will be replaced", kept]


def test_the_line_of_a_run_counts_one_and_says_what_the_first_frame_took():
    line = describe_run(Path("run/video.mp4"), (64, 96), 1, 1, 2.5, 2.5)
    assert line.startswith(
        "run/video.mp4: 1 frame, 96x64 px, 1 view; 2.5 s, of which 2.5 s prepare"
    )
    line = describe_run(Path("run/video.mp4"), (64, 96), 9, 61, 2.0, 14.0)
    assert "61 frames, 96x64 px, 9 views; 14.0 s, of which 2.0 s prepare the network" in line
    assert "after the first frame 5.0 frames per second" in line


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["output_format=gif"], "; shown at playback_fps=30, 4 times slower than real time"),
        (["fps=15"], "; shown at playback_fps=30, 2 times faster than real time"),
        (["output_format=film", "fps=30"], "; shown at playback_fps=30, in real time"),
        (["output_format=hdf5"], ""),
    ],
)
def test_the_line_of_a_run_says_how_fast_a_film_is_shown(given, said, tmp_path):
    cfg = config("reconstruct", tmp_path, "recording=cap.raw", *given)
    assert describe_playback(cfg) == said


def test_a_faster_form_is_named_after_a_slow_run_that_it_can_run(tmp_path, monkeypatch):
    net, chosen = load("setnet_small"), ["recording=x", "ckpt=setnet_small"]
    monkeypatch.setattr("src.reconstruct.fastest_form", lambda: "openvino")
    cfg = config("reconstruct", tmp_path, *chosen)
    assert suggest_faster_form(cfg, net, 60.0) == "; form=openvino is faster here"
    assert not suggest_faster_form(cfg, net, 2.0)
    assert not suggest_faster_form(cfg, load("clean/etnet"), 60.0)
    assert not suggest_faster_form(config("reconstruct", tmp_path, *chosen, "form=bf16"), net, 60.0)
    monkeypatch.setattr("src.reconstruct.fastest_form", lambda: "bf16")
    assert not suggest_faster_form(cfg, net, 60.0)


def test_a_post_processor_is_refused_without_keys_that_are_not_there(tmp_path):
    cfg = config("reconstruct", tmp_path, "recording=x", "ckpt=mambatm")
    with pytest.raises(ValueError, match="ckpt must be .* got a post-processor of frames$"):
        reconstruct(cfg)


def test_progress_counts_from_the_start_of_the_recording_on_any_clock(capsys):
    frames = (reconstruction.Frame(1605537494 + k / 100, np.zeros((2, 2)), 1, 0) for k in (1, 2, 3))
    assert len(list(show_progress(frames, 0.5 + 0.01))) == 3  # start_s=0.5, fps=100
    assert capsys.readouterr().out.splitlines()[-1].split("frames, ")[1].startswith("0.53 s")


def test_without_other_numbers_of_views_the_panel_is_left_out(folder, found, tmp_path):
    chosen = [f"recording={folder}/dot.raw", f"views={found}", "ckpt=lf3x3", "end_s=0.02"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen, "output_format=film"))
    assert cv2.VideoCapture(str(run / "film.mp4")).read()[1].shape[1] == 2 * 88 + 4


def test_without_views_the_sensor_is_one_view(folder, tmp_path):
    chosen = [f"recording={folder}/dot.raw", HIGHPASS, "output_format=png", "resolution=[90,160]"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen))
    assert cv2.imread(str(run / "frames/0000000.png"), 0).shape == (90, 160)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ("recording=nowhere.raw", "nowhere.raw"),
        ("sensor_size=[480,0]", "sensor_size must be .height, width., whole numbers in 1"),
        ("fps=1", "longer than one window"),
        ("fps=-1", "fps must be"),
        ("output_format=avi", "output_format must be one of"),
        ("splat=hat", "splat must be"),
        ("form=half", "form must be one of"),
        ("form=bf16", "form must be float32 for a network without parameters"),
        ("start_s=3.0 end_s=2.0", "start_s must be"),
        ("start_s=10", "start_s must be below the length of the recording, 0.1"),
        ("ckpt=null", "must name a network"),
        ("backward_warmup_s=-1", "must be >= 0 seconds"),
        ("noise_filter_s=0", r"noise_filter_s must be in \(0, 1e6\] seconds or null, got 0"),
        ("noise_filter_s=1e30", r"noise_filter_s must be in \(0, 1e6\] seconds or null, got 1e"),
        ("views=", "views must be a file of calibrate task=views, got none: No such file"),
        ("output_format=gif playback_fps=60", r"playback_fps must be in \[0.1, 50\] for output_f"),
        ("playback_fps=1e30", r"playback_fps must be in \[0\.1, 1000\], got 1e\+30"),
    ],
)
def test_wrong_values_are_refused_and_leave_no_file(folder, wrong, message, tmp_path):
    chosen = [f"recording={folder}/dot.raw", *([HIGHPASS] if wrong != "ckpt=null" else [])]
    with pytest.raises(ValueError, match=message):
        reconstruct(config("reconstruct", tmp_path / "run", *chosen, *wrong.split()))
    assert not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize(
    "wrong", ["output_format=avi", "playback_fps=0", "noise_filter_s=0", "backward_warmup_s=-1"]
)
def test_a_wrong_value_is_refused_before_the_network_is_loaded(wrong, tmp_path):
    with pytest.raises(ValueError, match=f"{wrong.split('=')[0]} must be"):
        reconstruct(config("reconstruct", tmp_path / "run", "recording=x", "ckpt=nowhere", wrong))


def test_a_calibration_that_fails_leaves_what_was_found(folder, tmp_path):
    chosen = ["task=views", f"recording={folder}/dot.raw"]
    with pytest.raises(ValueError, match="seen in 4 or more views"):
        calibrate(config("calibrate", tmp_path / "run", *chosen))
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left == {"found.png", "config.partial.yaml"}


def test_a_refusal_beside_earlier_results_leaves_no_config(folder, found):
    before = {path.name: path.read_bytes() for path in (folder / "a").iterdir()}
    with pytest.raises(ValueError, match="mirrors must be true"):
        calibrate(
            config(
                "calibrate", folder / "a", "task=views", f"recording={folder}/dot.raw",
                "target=scene", "mirrors=false",
            )
        )  # fmt: skip
    assert {path.name: path.read_bytes() for path in (folder / "a").iterdir()} == before


def test_sides_that_the_aspect_leaves_out_are_said_with_what_keeps_them():
    wide = simulated_recording.kaleidoscope_views(
        list(layout(9)), model=(92, 116), sensor=SENSOR, tile_px=116.0
    )
    assert describe_resolution(wide) == "116x92 px"
    square = describe_resolution(dataclasses.replace(wide, model=(92, 92)))
    assert re.fullmatch(
        r"92x92 px; (1\d|2\d)% of each view is left out, left and right: .*", square
    )
    assert 108 <= int(re.search(r"resolution=\[92,(\d+)\] keeps it", square)[1]) <= 120
    flat = describe_resolution(dataclasses.replace(wide, model=(46, 116)))
    assert re.search(r"left out, top and bottom: resolution=\[9\d,116\] keeps it", flat)


def test_what_is_measured_is_printed_a_line_each_and_where_it_is_saved(
    folder, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(TASKS, "air", lambda *given: {"tilt_px": 0.12423904962, "on": (0.2, 1.0)})
    given = ["task=air", f"video={tmp_path}", f"save={tmp_path}/air.yaml"]
    calibrate(config("calibrate", tmp_path / ("long" * 20), *given))
    lines = ["tilt_px: 0.124", "on: 0.2, 1", f"saved in {tmp_path}/air.yaml"]
    assert capsys.readouterr().out.splitlines() == [*lines, f"in {tmp_path}/{'long' * 20}"]


def test_corners_by_hand_replace_the_target(folder, found, tmp_path):
    there = views.load_views(found)
    lines = [
        f"- {{position: {list(view.position)}, corners: {there.outline(view).tolist()}}}"
        for view in there.views
    ]
    (tmp_path / "corners.yaml").write_text("\n".join(lines))
    chosen = ["task=views", f"recording={folder}/board.raw", f"corners={tmp_path}/corners.yaml"]
    calibrate(config("calibrate", tmp_path / "run", *chosen))
    by_hand = views.load_views(tmp_path / "run" / "views.yaml")
    for mine, auto in zip(by_hand.views, there.views, strict=True):
        assert by_hand.mirrored_xy(mine) == there.mirrored_xy(auto)


def test_turbulence_of_a_film_of_dots(folder, found, tmp_path):
    there = views.load_views(found)
    at_full = views.Views(there.sensor, (SIDE, SIDE), there.field, there.views)
    grid = np.array([[x, y] for y in (30.0, 60.0, 90.0) for x in (30.0, 60.0, 90.0)])
    table = sensor_lookup.build_lookup(at_full)
    light = simulated_recording.vignette_gain(table, 0.2)
    rng = np.random.default_rng(0)
    for name, spread, frames in (("still", 0.0, 4), ("dots", 0.7, 8)):
        centres = grid + spread * rng.normal(size=(frames, 9, 2))
        film = pictures.dot_grid(
            centres, np.full((frames, 9), 3.0), np.full((frames, 9), -0.6), SIDE
        )
        films = torch.from_numpy(film).float()[None].expand(9, -1, -1, -1)
        (tmp_path / name).mkdir()
        for k, seen in enumerate(
            simulated_recording.render_sensor_frames(films, table, light, slice(None)).numpy()
        ):
            cv2.imwrite(
                str(tmp_path / name / f"{k:03d}.png"), np.clip(seen * 255, 0, 255).astype(np.uint8)
            )
    chosen = [f"recording={tmp_path}/dots", f"still={tmp_path}/still", f"views={found}"]
    calibrate(config("calibrate", tmp_path / "run", "task=turbulence", *chosen))
    with open(tmp_path / "run" / "turbulence.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 81 and sum(int(row["failed"]) for row in rows) == 0
    scale = 88 / (there.field[2] - there.field[0]) * (at_full.field[2] - at_full.field[0]) / SIDE
    rms = np.mean([float(row["tilt_x_rms_px"]) for row in rows])
    assert rms == pytest.approx(0.7 * scale, rel=0.15)
    assert (tmp_path / "run" / "turbulence.png").is_file()


def test_the_sensor_of_a_recording_that_states_none_is_that_of_its_views(folder, found, tmp_path):
    here = f"recording={folder}/dot.npz"
    chosen = [here, f"views={found}", HIGHPASS, "output_format=hdf5"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *chosen))
    with h5py.File(run / "video.h5") as file:
        assert file["frames"].shape[1:] == (88, 88)
    server = build_server(config("live", tmp_path, *chosen[:3], "offered_networks=[]"))
    assert server.page.player.reader.feed.sensor == SENSOR
    with pytest.raises(ValueError, match=r"must be the recording's \(400, 640\)"):
        reconstruct(config("reconstruct", tmp_path / "wrong", *chosen, "sensor_size=[400,640]"))
    with pytest.raises(ValueError, match="does not state its sensor; give sensor_size="):
        reconstruct(config("reconstruct", tmp_path / "none", here, HIGHPASS))


def test_offered_networks_are_words(folder, tmp_path):
    chosen = [f"recording={folder}/dot.raw", HIGHPASS, "offered_networks=[[1,2],[3,4]]"]
    with pytest.raises(ValueError, match="offered_networks must be a list of words, got"):
        build_server(config("live", tmp_path, *chosen))


def test_a_lens_array_is_sent_to_a_board(folder, tmp_path):
    chosen = ["task=views", f"recording={folder}/dot.raw", "target=scene", "mirrors=false"]
    with pytest.raises(ValueError, match="mirrors must be true .* got false: .* target=checkerbo"):
        calibrate(config("calibrate", tmp_path / "run", *chosen))


def test_views_as_small_as_no_network_takes_are_not_calibrated(folder, tmp_path):
    chosen = ["task=views", f"recording={folder}/board.raw", "resolution=[5,1]"]
    with pytest.raises(ValueError, match="must be >= 8 px.*resolution, .* got 5 and 1"):
        calibrate(config("calibrate", tmp_path / "run", *chosen))
    assert not list((tmp_path / "run").iterdir())


def test_another_task_is_refused(tmp_path):
    with pytest.raises(ValueError, match="task must be one of"):
        calibrate(config("calibrate", tmp_path / "run", "task=guess", "recording=a.raw"))


@pytest.mark.parametrize("wrong", [-1, 2.5])
def test_windows_before_those_compared_are_a_whole_number(wrong, tmp_path):
    chosen = ["task=threshold", "recording=a.raw", f"warmup_windows={wrong}"]
    with pytest.raises(ValueError, match=f"warmup_windows must be a whole number .*, got {wrong}"):
        calibrate(config("calibrate", tmp_path / "run", *chosen))


def test_a_recording_of_noise_is_told_of_and_clips_are_longer_by_the_warmup(
    folder, found, tmp_path, monkeypatch
):
    given, rates = [], np.array([1.0, 1.0])
    curve = contrast_threshold.RateCurve(np.array([0.1, 1.0]), np.ones((2, 2, 2)), 1.0)
    estimate = contrast_threshold.ThresholdEstimate(
        (0.3, 0.2, 0.4), (0.3, 0.2, 0.4), curve, rates, np.ones((2, 2)), noise=rates / 4
    )

    def estimate_later(measured, clips, fps, sensor, *, progress, warmup):
        given.append(([clip.shape[1] for clip in clips], warmup))
        return estimate

    monkeypatch.setattr(contrast_threshold, "estimate_contrast_threshold", estimate_later)
    cfg = config(
        "calibrate", tmp_path / "run", "task=threshold", f"recording={folder}/dot.raw",
        f"views={found}", "scene.height=32", "scene.width=32", "turbulence=none", "clips=2",
        "optics=single", "data.test_windows=2", "data.substeps=2", "warmup_windows=3",
    )  # fmt: skip
    with pytest.warns(UserWarning, match="25% of the recording's events .* without change of li"):
        summary = calibrate(cfg)
    assert given == [([11, 11], 6)]
    assert summary["noise, share of the events"] == 0.25
    assert "noise_hz,,0.25,0.25" in (tmp_path / "run" / "threshold.csv").read_text()


def test_threshold_of_a_recording_of_the_simulated_clip_is_found_high_by_stray_light(tmp_path):
    cfg = config(
        "calibrate", tmp_path / "run", "task=threshold", f"recording={tmp_path}/cap.npz",
        f"views={tmp_path}/cap.views.yaml", "scene.height=64", "scene.width=64",
        "scene.speed_widths_per_s=[1.0,1.5]", "data.test_windows=12", "turbulence=none",
        "sensor=ideal", "sensor.initial_reference_error=0", "warmup_windows=0", "clips=1",
        "fps=120",
    )  # fmt: skip
    pipeline = simulation.build_pipeline(cfg, "test")
    clip, fps = pipeline.render_views([pipeline.draw(0)])[0], cfg.fps * cfg.data.substeps
    truth = simulated_recording.kaleidoscope_views(
        list(layout(9)), model=(64, 64), sensor=(220, 220)
    )
    sensor = dataclasses.replace(pipeline.sensor, threshold=0.3)
    simulated_recording.write_recording(tmp_path / "cap.npz", clip, fps, truth, sensor)
    with pytest.warns(UserWarning, match="clips=1: the interval holds no difference of scenes"):
        calibrate(cfg)
    with open(tmp_path / "run" / "threshold.csv") as file:
        rows = {row["what"]: row for row in csv.DictReader(file)}
    assert (tmp_path / "run" / "threshold.png").is_file()
    for polarity in ("on", "off"):
        assert 0.3 < float(rows["estimate"][polarity]) < 1.25 * 0.3


def test_comparing_videos_draws_them_and_measures_their_slices(folder, found, tmp_path):
    chosen = [
        f"recording={folder}/dot.raw",
        f"views={found}",
        HIGHPASS,
        "output_format=hdf5",
        "fps=300",
    ]
    videos = []
    for source in ("centre", "median"):
        wanted = [*chosen, f"+baseline.view_reduction={source}"]
        videos.append(reconstruct(config("reconstruct", tmp_path / source, *wanted)) / "video.h5")
    line = ["line=[[0,70],[87,20]]", "fps=300", f"videos=[{videos[0]},{videos[1]}]"]
    numbers = compare(config("compare", tmp_path / "run", *line))
    assert set(numbers) == {"centre", "median"}
    assert (tmp_path / "run" / "comparison.png").is_file()
    with pytest.raises(ValueError, match="fps must be that of .*centre/video.h5, 300, got 120"):
        compare(config("compare", tmp_path / "wrong", line[0], line[2], "fps=120"))


def test_what_turns_uniformly_is_straight_in_theta_and_still_in_r(tmp_path, monkeypatch):
    drawn, draw = [], comparison.draw_comparison
    monkeypatch.setattr(
        comparison, "draw_comparison", lambda *rows, **how: drawn.append(how) or draw(*rows, **how)
    )
    (tmp_path / "film").mkdir()
    y, x = np.mgrid[:61, :61]
    for k in range(24):
        angle = np.radians(20 + 24 * k)
        dot = np.hypot(x - 30 - 18 * np.cos(angle), y - 30 - 18 * np.sin(angle))
        picture = (255 * np.clip(4.5 - dot, 0, 1)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"film/{k:02d}.png"), picture)
    film = [f"videos=[{tmp_path}/film]", "names=[film]", "fps=120"]
    along = [*film, "spin=[30,30,28,8,20]"]
    still = compare(config("compare", tmp_path / "r", *along))["film"]
    round_ = compare(config("compare", tmp_path / "theta", *film, "circle=[30,30,18]"))["film"]
    assert still["residual_displacement_px"] < 0.1 and round_["line_deviation_px"] < 0.2
    assert [how["axis"] for how in drawn] == ["r", "theta"]


def test_the_tail_behind_a_bright_dot_is_not_followed(tmp_path):
    (tmp_path / "film").mkdir()
    y, x = np.mgrid[:20, :80]
    for k in range(24):
        dot = np.clip(4.5 - np.hypot(x - 10 - 2 * k, y - 10), 0, 1)
        tail = (x < 4 + 2 * k) & (x > 2 * k - 8 - 8 * np.sin(k / 2))
        picture = (100 + 150 * dot - 90 * tail).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"film/{k:02d}.png"), picture)
    given = [f"videos=[{tmp_path}/film]", "names=[film]", "line=[[0,10],[79,10]]"]
    found = {
        follow: compare(
            config("compare", tmp_path / follow, *given, f"moving_object_brightness={follow}")
        )["film"]
        for follow in ("any", "bright")
    }
    assert found["bright"]["line_deviation_px"] < 0.1 < 1 < found["any"]["line_deviation_px"]


def test_videos_of_two_sizes_are_not_compared(tmp_path):
    for side in (20, 30):
        (tmp_path / str(side)).mkdir()
        for k in range(2):
            cv2.imwrite(str(tmp_path / f"{side}/{k}.png"), np.zeros((side, side), np.uint8))
    films = f"videos=[{tmp_path}/20,{tmp_path}/30]"
    with pytest.raises(ValueError, match="videos must be of one size"):
        compare(config("compare", tmp_path / "run", films, "line=[[0,0],[19,0]]"))


def test_of_videos_of_two_lengths_the_common_frames_are_compared(tmp_path, capsys):
    rng = np.random.default_rng(0)
    film = np.repeat(rng.integers(0, 255, (1, 40, 50)), 9, axis=0)
    film[4:] = rng.integers(0, 255, (5, 40, 50))
    for name, frames in (("long", 9), ("short", 4)):
        (tmp_path / name).mkdir()
        for k, frame in enumerate(film[:frames]):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), frame.astype(np.uint8))
    videos = f"videos=[{tmp_path}/long,{tmp_path}/short]"
    found = compare(config("compare", tmp_path / "run", videos, "names=[a,b]", "still=8"))
    assert found["a"] == found["b"] and found["a"]["flicker"] == 0
    assert "the first 4 of these frames of each are compared: a 9, b 4" in capsys.readouterr().out


@pytest.mark.parametrize(("first", "start_s"), [(3, 0.025), (-2, 0.05)])
def test_times_of_a_comparison_are_those_of_the_video(first, start_s, tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    for k in range(8):
        cv2.imwrite(str(tmp_path / f"a/{k}.png"), np.full((20, 20), 30 * k, np.uint8))
    told = {}
    monkeypatch.setattr(comparison, "draw_comparison", lambda *_, **how: told.update(how))
    cut = f"videos=[{tmp_path}/a]", "line=[[0,0],[9,0]]", f"first={first}"
    compare(config("compare", tmp_path / "run", *cut))
    assert told["start_s"] == pytest.approx(start_s)


def test_a_measure_that_two_frames_do_not_show_is_a_dash(tmp_path, capsys):
    (tmp_path / "film").mkdir()
    y, x = np.mgrid[:20, :80]
    for k in range(2):
        picture = (200 * np.clip(4.5 - np.hypot(x - 30 - 9 * k, y - 10), 0, 1)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"film/{k}.png"), picture)
    film = [f"videos=[{tmp_path}/film]", "line=[[0,10],[79,10]]"]
    compare(config("compare", tmp_path / "run", *film))
    said = capsys.readouterr().out
    assert "residual displacement, if static: " in said and "nan" not in said
    assert "deviation from a line, if moving: -\n" in said


def test_videos_of_two_shapes_are_not_stretched(tmp_path):
    for name, size in (("wide", (20, 30)), ("high", (50, 10))):
        (tmp_path / name).mkdir()
        for k in range(2):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), np.zeros(size, np.uint8))
    films = f"videos=[{tmp_path}/wide,{tmp_path}/high]"
    got = r"videos must be of one aspect ratio, got wide 20x30 and high 50x10 \(h x w\)"
    with pytest.raises(ValueError, match=got):
        compare(config("compare", tmp_path / "run", films, "names=[wide,high]", "still=2"))


@pytest.mark.parametrize(
    "wrong, message",
    [
        ("line=null", "one of line, circle, spin and still"),
        ("line=[[0,0],[500,0]]", "line must stay"),
        ("circle=[15,10,60]", "circle must stay"),
        ("circle=[15,10,-3]", "circle must have a radius of 1 pixel or more"),
        ("spin=[15,10,-3,1,0]", "spin must have a radius of 1 pixel or more"),
        ("still=0", r"still must be in 1\.\."),
        (
            "line=[[0,0],[9,0]] first=1 last=2",
            "first and last must leave two frames or more, got 1",
        ),
        ("line=[[0,0],[9,0]] first=9", "two frames or more, got 9 and null: .* has 3 frames"),
        ("line=[[0,0],[9,0]] frames_shown=0", r"frames_shown must be in 1\.\.100, got 0"),
        ("line=[[0,0],[9,0]] frames_shown=10000000", r"frames_shown must be in 1\.\.100, got 1"),
        ("line=[[5,5],[5,5]]", "line must have two ends that differ"),
        ("line=[[inf,5],[5,5]]", r"line must have numbers in \[-100000, 100000\], got"),
        ("circle=[nan,16,5]", "circle must have numbers in"),
        ("spin=[16,16,5,1e30,0]", "spin must have numbers in"),
        ("still=1.5", "still must be a whole number of pixels or null, got 1.5"),
        ("still=2 videos=[[1,2],[3,4]]", "videos must be a list of words, got"),
        ("still=2 names=[[1,2]]", "names must be a list of words, got"),
        ("still=2 videos=[/no/a,/no/b]", "videos must be films or .* that exist, got /no/a"),
        ("still=2 reference_images=/no/images.txt", "reference_images .*, /no/images.txt is not"),
        (
            "line=[[0,0],[9,0]] moving_object_brightness=all",
            "moving_object_brightness must be one of",
        ),
    ],
)
def test_a_slice_that_cannot_be_taken_is_refused(wrong, message, tmp_path):
    (tmp_path / "film").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "film" / f"{k}.png"), np.zeros((20, 30), np.uint8))
    with pytest.raises(ValueError, match=message):
        compare(config("compare", tmp_path / "run", f"videos=[{tmp_path}/film]", *wrong.split()))
    assert not list((tmp_path / "run").iterdir())


def test_a_scene_that_stands_wanders_by_its_shifts_whatever_the_size(tmp_path):
    y, x = np.mgrid[:96, :96]
    for name, side in (("large", 96), ("small", 48)):
        (tmp_path / name).mkdir()
        for k in range(16):
            shift = 1.5 * np.sin(1.7 * k)
            picture = 128 + 60 * np.sin((x - shift) / 5) + 60 * np.sin((y - shift) / 7)
            picture = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(tmp_path / name / f"{k:02d}.png"), picture.astype(np.uint8))
    given = [f"videos=[{tmp_path}/large,{tmp_path}/small]", "names=[large,small]", "still=8"]
    found = compare(config("compare", tmp_path / "run", *given))
    for values in found.values():  # both are looked at with 48 pixels
        assert values["residual_displacement_px"] == pytest.approx(0.75 / 2**0.5, rel=0.1)
    assert (tmp_path / "run" / "comparison.png").is_file()
    with pytest.raises(ValueError, match="give one of line, circle, spin and still"):
        compare(config("compare", tmp_path / "none", *given, "line=[[0,0],[9,9]]"))


def test_every_video_of_a_comparison_has_a_name_of_its_own(tmp_path):
    assert default_video_names([Path("a/video.h5"), Path("b/video.h5")]) == ["a", "b"]
    assert default_video_names([Path("a/one.h5"), Path("a/two.h5")]) == ["a/one", "a/two"]
    alike = [f"videos=[{tmp_path},{tmp_path}]", "names=[n,n]", "line=[[0,8],[17,8]]"]
    with pytest.raises(ValueError, match="names must differ, got n, n"):
        compare(config("compare", tmp_path, *alike))
