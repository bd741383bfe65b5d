"""A value of a wrong kind and a key that is none end in one line, before anything runs."""

import sys

import pytest
from omegaconf import OmegaConf

from src import simulate
from src.app.before_imports import refuse_wrong_overrides
from src.app.config_values import LIST, NULL, NUMBER, WORD, _kinds_like
from tests.test_entry_points import run_here

WRONG = [
    ("reconstruct", ["recording=x", "fps=abc"], "fps must be a number, got abc"),
    ("reconstruct", ["recording=x", "fps=1/60"], "fps must be a number, got 1/60"),
    ("reconstruct", ["recording=x", "sensor_size=720"], "sensor_size must be a list or null"),
    ("reconstruct", ["recording=x", "sensor_size=[720]"], "sensor_size must be [height,width], wh"),
    ("reconstruct", ["recording=x", "resolution=[a,b]"], "resolution must be [height,width], wh"),
    ("reconstruct", ["ckpt=setnet_small"], "recording must be given: recording=..."),
    ("calibrate", ["task="], "task must be a word, got none"),
    ("calibrate", [], "task must be given: task=..."),
    ("reconstruct", ["recording=null"], "recording must be a word, got null"),
    ("reconstruct", ["recording="], "recording must be a path, got ''"),
    ("reconstruct", ["recording=x", "sensor_size=[8193,320]"],
     "sensor_size must be [height,width], whole numbers in 1..8192, got [8193, 320]"),
    ("reconstruct", ["recording=x", "ckpt=[a,b]"], "ckpt must be a word or null, got"),
    ("reconstruct", ["recording=docs", "ckpt=setnet_small", "device=cuda:9"], "device must be"),
    ("reconstruct", ["recording=x", "+unknown=1"], "unknown is no key of the configuration"),
    ("simulate", ["camera.tile_px=abc"], "camera.tile_px must be a number or null, got abc"),
    ("simulate", ["index=-1"], "index must be >= 0, got -1"),
    ("simulate", ["photo=README.md", "scene.height=8"], "scene.height must not be given with a"),
    ("simulate", ["video=README.md", "bins=2"], "bins must not be given with a video or ph"),
    ("simulate", ["data.test_crop=inf"], "data.test_crop must be pixels (128), a share of the fr"),
    ("simulate", ["data.test_crop=nan"], "data.test_crop must be pixels (128), a share of the fr"),
    ("simulate", ["data.test_crop=1e30"], "a share of the frame (0.5) or null, got 1e+30"),
    ("train", ["data.crop=nan"], "data.crop must be pixels (128), a share of the frame (0.5) or n"),
    ("simulate", ["data.substeps=100000000000"], "data.substeps must be in 1..10000, got 10000000"),
    ("simulate", ["data.test_windows=100000000000"], "data.test_windows must be in 1..1000000, go"),
    ("train", ["data.windows=100000000000"], "data.windows must be in 1..1000000, got 1000000000"),
    ("train", ["data.cache_windows=10000000000"], "data.cache_windows must be in 1..1000000, got"),
    ("simulate", ["bins=100000000000"], "bins must be in 1..1000, got 100000000000"),
    ("simulate", ["data.unknown=1"], "data.unknown is no key of the configuration"),
    ("simulate", ["turbulence=rigid"], "turbulence=rigid is now turbulence=mixed turbulence.atm"),
    ("train", ["experiment=lf_firenet"], "experiment=lf_firenet was removed"),
    ("train", ["experiment=lf9x9"], "lf9x9"),
    ("train", ["trainer.max_steps=abc"], "trainer.max_steps must be a whole number, got abc"),
    ("train", ["ckpt=setnet_medium"], "ckpt=setnet_medium must be of the network that is trained"),
    ("train", ["calm=1"], "calm is now loss.static_flicker.weight"),
    ("simulate", ["turbulence.rms_px=3"], "turbulence.rms_px is now turbulence.tilt_rms_px"),
    ("simulate", ["+turbulence.rms_px=3"], "turbulence.rms_px is now turbulence.tilt_rms_px"),
    ("eval", ["+calm=1"], "calm is now loss.static_flicker.weight"),
    ("report", ["++calm=1", "run=nowhere"], "calm is now loss.static_flicker.weight"),
    ("chart", ["~calm"], "calm is now loss.static_flicker.weight"),
    ("eval", [], "ckpt or baseline must name a network"),
    ("eval", ["ckpt=nowhere"], "ckpt must be a file or one of weights/"),
    ("compare", ["videos=a.h5"], "videos must be a list, got a.h5"),
    ("compare", ["videos=[docs]", "fps=0"], "fps must be > 0 frames a second, got 0"),
    ("compare", ["videos=[docs]", "line=[[a,b],[c,d]]"], "line must be numbers as in [[0, 88], ["),
    ("compare", ["videos=[docs]", "line=[1,2]"], "line must be numbers as in [[0, 88], [175, 88]]"),
    ("compare", ["videos=[docs]", "circle=[1]"], "circle must be numbers as in [88, 88, 40], got"),
    ("compare", ["videos=[docs]", "spin=[[1,2],3]"], "spin must be numbers as in [88, 88, 40, 2.5"),
    ("convert", ["recording=x"], "out must be given: out=..."),
    ("convert", ["recording=x", "out=y.h5"], "recording must be a file or a folder, got x: no"),
    ("reconstruct", ["recording=x"], "recording must be a file or a folder, got x: no such file"),
    ("reconstruct", [f"recording={'x' * 300}"], "x: file name too long"),
    ("report", ["run=[docs,x]"], "run must be a file or a folder, got x: no such file"),
    ("calibrate", ["task=air", "video=x"], "video must be a file or a folder, got x: no such file"),
    ("calibrate", ["task=air"], "video must be given: video=..."),
    ("reconstruct", ["recording=docs", "ckpt=setnet_small"], "recording must be an event file"),
    ("calibrate", ["recording=docs", "task=threshold", "save=a.yaml"], "save must be null for tas"),
    ("live", ["recording=docs", "threads=0"], "threads must be in 1..1024, got 0"),
    ("live", ["recording=docs", "threads=10000000000"], "threads must be in 1..1024, got 10000000"),
    ("live", ["recording=x", "host=1.5"], "host must be a word, got 1.5"),
    ("train", ["data.large=5"], "data.large must be a mapping or null, got 5"),
    ("train", ["augment=views", "augment.max_view_shift_px=2.5"],
     "augment.max_view_shift_px must be a whole number, got 2.5"),
    ("train", ["stem=0"], "stem must be in 1..4096, got 0"),
    ("train", ["width=5000"], "width must be in 1..4096, got 5000"),
    ("train", ["data.workers=100000"], "data.workers must be in 0..1024, got 100000"),
    ("train", ["trainer.check_val_every_n_epoch=0"], "check_val_every_n_epoch must be >= 1, got 0"),
    ("train", ["trainer.accelerator=auto", "data.crop=nan"],
     "trainer.accelerator must be cpu or gpu, got auto"),
    ("eval", ["trainer.accelerator=cuda"], "trainer.accelerator must be cpu or gpu, got cuda"),
    ("train", ["start=null", "hydra.job.name=train_ddp_process_1", "data.crop=nan"],  # as Lightning
     "data.crop must be pixels (128)"),
    ("train", ["data.rates=[1e30]"], "data.rates must be in [0.001, 1e6] windows a second, got"),
    ("simulate", ["write=a.raw", "camera.sensor_size=[10,10]"],
     "camera.sensor_size and camera.tile_px must hold all views, got [10, 10] and None: views: "),
]  # fmt: skip


@pytest.mark.parametrize(("name", "overrides", "said"), WRONG)
def test_one_line_and_exit_code_2(name, overrides, said, tmp_path, capsys):
    words = [*overrides, f"paths.out={tmp_path}"]
    with pytest.raises(SystemExit) as end:
        refuse_wrong_overrides(name, words)
        sys.exit(run_here(name, *words))
    assert end.value.code == 2
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith("error: ") and said in line and printed.out == ""


def test_a_recording_that_cannot_be_written_is_refused_before_it_is_made(tmp_path, monkeypatch):
    monkeypatch.setattr(simulate.simulation, "build_pipeline", None)
    cfg = OmegaConf.create({
        "paths": {"run": str(tmp_path)}, "index": 0, "write": "a.xyz", "like": None,
        "video": None, "photo": None,
        "camera": {"sensor_size": [360, 640]},
    })  # fmt: skip
    with pytest.raises(ValueError, match="write must end in one of .raw, .* got a.xyz"):
        simulate.simulate(cfg)


@pytest.mark.parametrize(
    ("key", "default", "kinds"),
    [
        ("fps", 120.0, (NUMBER,)),
        ("sensor.threshold", [0.1, 0.7], (NUMBER, LIST, NULL)),
        ("split", "test", (WORD,)),
        ("last", None, ()),
    ],
)
def test_the_shipped_value_says_what_a_key_takes(key, default, kinds):
    assert _kinds_like(key, default) == kinds
