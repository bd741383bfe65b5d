"""Your own video and photograph through src.simulate, and the same from Python."""

import inspect
import re
import shlex
import subprocess

import cv2
import h5py
import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from PIL import Image

from src.app import user_clip_simulation
from src.app.compose import compose_config
from src.app.python_interface import simulate as simulate_arrays
from src.app.user_clip_simulation import UserClipSimulation
from src.recordings.files import read_events
from src.recordings.views import load_views
from src.sim import noise
from src.sim.scenes.user_clip import clip_from_array
from src.sim.turbulence.operator import Turbulence
from src.simulate import print_files, simulate
from tests.conftest import ROOT, default_dtype
from tests.sim.scenes.test_user_clip import LEVELS, write_film
from tests.test_recording_entry_points import config

SMALL = ["camera.sensor_size=[120,160]", "turbulence=strong"]


def textured(frames: int = 5, size=(40, 56)) -> np.ndarray:
    rng = np.random.default_rng(1)
    wide = rng.uniform(0.1, 0.9, (size[0] // 8, size[1] // 8 + frames)).repeat(8, 0).repeat(8, 1)
    return np.stack([wide[:, 4 * k : 4 * k + size[1]] for k in range(frames)]).astype(np.float32)


def test_a_video_gives_events_geometry_and_truth_of_all_its_frames(tmp_path, capsys):
    film = write_film(tmp_path / "my.mkv")
    drawn = simulate(config("simulate", tmp_path / "run", f"video={film}", *SMALL))
    line = capsys.readouterr().out.splitlines()[0]
    assert line.startswith(
        "my: 64x36 px, 30 frames/s, all of 12 frames; simulated as 9 views of 64x"
    )
    tilt, blur = map(float, re.search(r"strong: tilt (\S+) px, blur (\S+) px rms;", line).groups())
    assert tilt == pytest.approx(drawn["tilt_px"], abs=0.006)
    assert np.hypot(tilt, blur) == pytest.approx(drawn["tilt_and_blur_px"], abs=0.01)
    assert line.endswith("; code values decoded from sRGB, contrast threshold 0.200")
    events = read_events(tmp_path / "run" / "my.raw")
    views = load_views(tmp_path / "run" / "my.views.yaml")
    assert len(events) > 500 and events["t"].max() < 11 / 30 * 1e6 and views.model == (36, 64)
    with h5py.File(tmp_path / "run" / "my.truth.h5") as file:
        assert (file["clean"][:, 9, 30] == LEVELS).all()
        assert file["views"].shape == (9, 12, 36, 64) and file["views"].compression == "gzip"
        assert file["tilt"].shape == (9, 12, 2, 36, 64) and 0.1 < np.abs(file["tilt"][:]).max() < 20
        assert np.allclose(file["time_s"], np.arange(12) / 30) and file.attrs["fps"] == 30
        assert file.attrs["threshold"] == drawn["threshold"]
    assert (tmp_path / "run" / "views.gif").stat().st_size > 1000
    assert not list(tmp_path.rglob("*partial*"))


@pytest.mark.parametrize("turbulence", ["none", "weak"])
def test_the_default_type_of_tensors_changes_nothing(turbulence):
    given = {"turbulence": turbulence, "views": 2, "fps": 120}
    ours = simulate_arrays(textured(), **given)
    with default_dtype(torch.float64):
        theirs = simulate_arrays(textured(), **given)
    for one, other in zip(ours, theirs, strict=True):
        assert one.dtype == other.dtype and (one == other).all()
    assert ours.drawn == theirs.drawn


def test_overrides_in_one_word_are_refused():
    with pytest.raises(ValueError, match=r"^overrides must be a list .*\['sensor.threshold=1'\]"):
        simulate_arrays(textured(2), fps=30, overrides="sensor.threshold=1")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"overrides": {"sensor.threshold": 1}}, "overrides must be a list of key=value, as in"),
        ({"overrides": 3}, "overrides must be a list of key=value, as in .*, got 3"),
        ({"overrides": ["abc"]}, "overrides must each be key=value, got 'abc'"),
        ({"overrides": [3]}, "overrides must each be key=value, got 3"),
        ({"seconds": "1"}, "seconds must be a number, got '1'"),
    ],
)
def test_arguments_of_another_kind_are_named(options, message):
    make = inspect.unwrap(simulate_arrays)  # without the type checks of tests
    with pytest.raises(ValueError, match=f"^{message}"):
        make(textured(1)[0], **options)


def test_a_masked_photograph_is_refused():
    masked = np.ma.masked_array(textured(1)[0], True)
    with pytest.raises(ValueError, match="^photo_or_video must be without a mask, got a masked"):
        simulate_arrays(masked)


def test_parts_are_those_of_the_whole_clip(tmp_path, monkeypatch):
    clip = clip_from_array(textured(), fps=60)
    cfg = compose_config("simulate", "turbulence=strong", "optics.views=3")
    work = UserClipSimulation(cfg, clip)
    assert (
        work.substeps == 2
        and work.simulated_frame_count == 9
        and isinstance(work.turbulence, Turbulence)
    )
    monkeypatch.setattr(user_clip_simulation, "PART_BYTES", 4 * 3 * 40 * 56 * 2)  # two frames
    seen = work.allocate_views(tmp_path)
    parts = list(work.simulate_parts(seen))
    key = noise.key(work.key, "turbulence")
    clean = clip.interpolate_frames(0, 9, 2)[None]
    whole = work.turbulence.degrade(clean, noise.generator(key))[0]
    tilt = work.turbulence.tilt(9, noise.generator(key))
    assert len(parts) == 5 and (seen.float() - whole).abs().max() < 1e-3
    assert torch.allclose(torch.cat([p.views for p in parts], 1), whole[:, ::2], atol=1e-5)
    assert torch.allclose(torch.cat([p.tilt for p in parts], 1), tilt[:, ::2], atol=1e-5)
    assert torch.allclose(torch.cat([p.clean for p in parts]), torch.from_numpy(clip.frames))


def test_from_python_the_result_is_that_of_the_command(tmp_path):
    film = write_film(tmp_path / "my.mkv")
    simulate(config("simulate", tmp_path / "run", f"video={film}", *SMALL))
    clip = simulate_arrays(film, turbulence="strong", views=9)
    with h5py.File(tmp_path / "run" / "my.truth.h5") as file:
        assert (np.round(clip.clean * 255) == file["clean"]).all()
        assert np.abs(clip.views * 255 - file["views"][:].astype(float)).max() < 0.501
        assert np.abs(clip.tilt - file["tilt"][:]).max() < 0.501 / 32
    clean, views, tilt, events = clip
    assert clean is clip.clean and views is clip.views and tilt is clip.tilt
    assert (np.diff(events["t"]) >= 0).all() and set(np.unique(events["view"])) == set(range(9))
    assert (np.abs(events["p"]) == 1).all() and events["x"].max() < 64 > events["y"].max()


def test_without_turbulence_events_are_the_threshold_crossings_of_the_clip():
    ramp = np.exp(np.linspace(np.log(0.1), np.log(0.8), 25))[:, None, None]
    frames = np.broadcast_to(ramp, (25, 20, 24)).astype(np.float32)
    sensor = ["sensor.threshold=0.25", "sensor.input=linear"]
    clip = simulate_arrays(frames, "none", 1, fps=240, sensor="ideal", overrides=sensor)
    assert (clip.views[0] == clip.clean).all() and not clip.tilt.any()
    assert len(clip.events) == 20 * 24 * int(np.log(8) / 0.25) and (clip.events["p"] == 1).all()
    first = clip.events["t"][0] * 1e-6 * 240  # frames until the light has grown by exp(0.25)
    assert first == pytest.approx(24 * 0.25 / np.log(8), abs=0.02)


@pytest.mark.parametrize("seed", [0, pytest.param(3, marks=pytest.mark.slow)])
def test_a_photograph_gives_events_by_default(tmp_path, seed):
    cv2.imwrite(str(tmp_path / "cat.png"), 255 * textured(2, (96, 128))[0])
    given = [f"photo={tmp_path}/cat.png", "seconds=0.2", f"seed={seed}", "optics.views=3"]
    drawn = simulate(config("simulate", tmp_path / "run", *given, "turbulence=strong"))
    events = read_events(tmp_path / "run" / "cat.raw")
    assert len(events) > 5000 and drawn["threshold"] == pytest.approx(0.2)
    assert 0.2 < (events["p"] > 0).mean() < 0.8
    assert "input: srgb" in (tmp_path / "run" / "config.yaml").read_text()


@pytest.mark.parametrize(
    "overrides, threshold, light",
    [
        ([], 0.2, "srgb"),
        (["sensor=noisy"], 0.2, "srgb"),
        (["sensor.threshold=0.35"], 0.35, "srgb"),
        (["sensor.threshold=[0.1,0.7]", "sensor.input=linear"], [0.1, 0.7], "linear"),
        (["~user_clip_sensor.threshold"], [0.1, 0.7], "srgb"),
        (["sensor=randomized"], 0.2, "srgb"),
        (["sensor=any_camera", "sensor.threshold=0.3"], 0.3, "srgb"),
        (["+user_clip_sensor.off_ratio=1.5"], 0.2, "srgb"),
    ],
)
def test_the_sensor_of_a_users_clip_is_what_is_set_else_its_own(overrides, threshold, light):
    cfg, scenes = compose_config("simulate", *overrides), compose_config("simulate")
    assert (scenes.sensor.threshold, scenes.sensor.input) == ([0.1, 0.7], "linear")
    user_clip_simulation.set_user_clip_sensor(cfg, overrides)
    assert (cfg.sensor.threshold, cfg.sensor.input) == (threshold, light)
    assert cfg.sensor.response == "log" and "threshold" not in (cfg.sensor.get("random") or {})
    assert cfg.sensor.off_ratio == (1.5 if "off_ratio" in str(overrides) else 1.0)
    stored = cfg.copy()  # run again by its config.yaml, without overrides
    user_clip_simulation.set_user_clip_sensor(stored, [])
    assert stored.sensor == cfg.sensor


def test_without_events_all_the_rest_is_there(tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "cat.png"), np.full((96, 128), 90, np.uint8))
    given = [f"photo={tmp_path}/cat.png", "seconds=0.1", "turbulence=none"]
    with pytest.warns(UserWarning, match=r"no events.*sensor.threshold= .*seconds= .*turbulence="):
        simulate(config("simulate", tmp_path / "run", *given))
    names = {path.name for path in (tmp_path / "run").iterdir()}
    wanted = {"cat.raw", "cat.views.yaml", "cat.truth.h5", "views.gif", "views.png"}
    assert wanted <= names and len(read_events(tmp_path / "run" / "cat.raw")) == 0
    said = capsys.readouterr().out
    assert "0 events in" in said and "next:" not in said


def test_the_next_command_can_be_pasted_whatever_the_path(tmp_path, capsys):
    path = tmp_path / "my cat.raw"
    (tmp_path / "my cat.truth.h5").write_bytes(b"")
    print_files(path, np.zeros(1), [])
    line = capsys.readouterr().out.splitlines()[-1]
    given = [f"recording={path}", f"views={tmp_path}/my cat.views.yaml", "ckpt=setnet_small"]
    assert shlex.split(line)[4:] == given


def test_a_seed_draws_anew_and_the_same_seed_the_same():
    same, again, other = (
        simulate_arrays(textured(3), "strong", 2, fps=120, seed=seed) for seed in (1, 1, 2)
    )
    assert (same.views == again.views).all() and (same.events == again.events).all()
    assert np.abs(same.views - other.views).max() > 0.01


@pytest.mark.parametrize(
    "options, message",
    [
        ({"turbulence": "heavy"}, "turbulence must be one of .*, strong, weak, got heavy"),
        ({"sensor": "nosy"}, "sensor must be one of .*, noisy, .*, got nosy"),
        ({"views": 7}, "views must be .*optics.views"),
        ({"overrides": ["foo=1"]}, "foo"),
        ({"overrides": ["fps=240"]}, "overrides must not set fps: it is the argument fps"),
        ({"overrides": ["write=a.raw"]}, "must not set write: it is of the command line alone"),
        ({"seed": 1.5}, "seed must be a whole number, got 1.5"),
        ({"overrides": ["least_simulated_fps=0"]}, "least_simulated_fps must be in"),
        (
            {"overrides": ["least_simulated_fps=fast"]},
            "least_simulated_fps must be a number, got f",
        ),
        ({"overrides": ["+foo=3"]}, "foo is no key of the configuration"),
        ({"overrides": ["index=-1"]}, "index must be >= 0, got -1"),
        (
            {"overrides": ["camera.tile_px=1"]},
            "set camera.tile_px: it is of the command line alone",
        ),
        ({"overrides": ["scene.height=8"]}, "scene.height must not be given with a video or photo"),
        ({"overrides": ["data.substeps=9"]}, "data.substeps must not be given with a video or ph"),
        ({"overrides": ["bins=2"]}, "bins must not be given with a video or photograph"),
        (
            {"overrides": ["user_clip_sensor.threshold=7"]},
            r"^user_clip_sensor.threshold must .* 7$",
        ),
        ({"overrides": ["sensor.threshold=7"]}, r"^sensor.threshold must be in .* got 7$"),
        ({"overrides": ["turbulence.tolerance=null"]}, r"turbulence.tolerance must be in \(0, 1\]"),
        ({"overrides": ["calm=1"]}, "calm is now loss.static_flicker.weight"),
        ({"overrides": ["+calm=1"]}, "calm is now loss.static_flicker.weight"),
        (
            {"turbulence": "measured", "overrides": ["turbulence.measured=air (1).yaml"]},
            r"turbulence.measured must be .*air \(1\).yaml",
        ),
    ],
)
def test_a_wrong_argument_is_one_line_and_leaves_hydra_as_it_was(options, message):
    before = GlobalHydra.instance().hydra
    with pytest.raises(ValueError, match=message) as error:
        simulate_arrays(textured(2), fps=30, **options)
    assert "\n" not in str(error.value) and GlobalHydra.instance().hydra is before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"overrides": ["sensor.dark_noise_hz=500"]}, "sensor.dark_noise_hz must be at most 120, "),
        *(
            (
                {"sensor": "any_camera", "seed": seed, "overrides": ["least_simulated_fps=30"]},
                "sensor.random.hot_pixel_hz must be at most 30, the frames a second that are",
            )
            for seed in range(3)
        ),
    ],
)
def test_more_noise_than_frames_is_refused_before_rendering(options, message, monkeypatch):
    monkeypatch.setattr(UserClipSimulation, "simulate_parts", None)
    with pytest.raises(ValueError, match=f"^{message}"):
        simulate_arrays(textured(2), fps=30, **options)


def test_pictures_are_known_by_what_they_hold(tmp_path):
    cv2.imwrite(str(tmp_path / "cat.webp"), textured(1)[0])
    Image.fromarray(textured(1)[0]).save(tmp_path / "one.gif")
    for name in ("cat.webp", "one.gif"):
        with pytest.warns(UserWarning, match="the clip gives no events"):
            seen = simulate_arrays(tmp_path / name, "none", 1, seconds=np.float32(0.1))
        assert seen.clean.shape == (13, 40, 56)
    (tmp_path / "cat.txt").write_text("no picture")
    with pytest.raises(ValueError, match="^video must be a video that FFmpeg can read"):
        simulate_arrays(tmp_path / "cat.txt")


def test_an_array_moves_as_a_photograph_does():
    given = {"seconds": 0.1, "overrides": ["speed_widths_per_s=0.5"]}
    assert len(simulate_arrays(textured(2)[0], "none", 1, **given).events) > 100
    with pytest.warns(UserWarning, match="the clip gives no events"):
        simulate_arrays(textured(2)[0], "none", 1, seconds=0.1)
    with pytest.raises(ValueError, match=r"fps must be in .*got 0"):
        simulate_arrays(textured(2)[0], "none", 1, fps=0)


@pytest.mark.parametrize(
    "given, message",
    [
        (["video=my.mkv", "photo=a.png"], "video must be null with photo=a.png"),
        (["video=my.mkv", "like=config.yaml"], "like must be null with video or photo"),
        (["video=my.mkv", "write=a.txt"], "write"),
        (["video=my.mkv", "seconds=0.5"], "seconds must be left out but for a photograph, .* 0.5"),
        (["video=my.mkv", "speed_widths_per_s=1"], "speed_widths_per_s must be 0 but for a photog"),
    ],
)
def test_keys_that_do_not_go_together(given, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        simulate(config("simulate", tmp_path / "run", *given))


def test_the_demo_is_recorded_where_it_is_played(tmp_path):
    given = ["make", "-n", "demo", f"DEMO={tmp_path}/demo"]
    told = subprocess.run(given, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert f"write={tmp_path}/demo/cap.raw" in told and f"recording={tmp_path}/demo/cap.raw" in told


def test_a_full_disk_is_told_before_the_work(tmp_path, monkeypatch):
    film = write_film(tmp_path / "my.mkv")
    cfg = config("simulate", tmp_path / "run", f"video={film}", *SMALL)
    monkeypatch.setattr(user_clip_simulation, "CLIP_FREE_BYTES", 1 << 60)
    with pytest.raises(ValueError, match=r"write must have .* MiB free"):
        simulate(cfg)
    assert not list(tmp_path.rglob("my.raw*")) and not list(tmp_path.rglob("*.h5*"))
