"""`pip install .`: one package that works from any folder, beside another package called src."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest

import lightfield_events
import lightfield_events.__main__
from setup import rename_imports
from src.deploy.cost import torch_threads
from src.deploy.runtime import EventListRuntime
from src.models import files
from tests.conftest import ROOT

USE = """
import sys
class NoLightning:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("lightning", "torchmetrics", "kornia", "wandb", "aiohttp"):
            raise ImportError(name)
sys.meta_path.insert(0, NoLightning())
import numba
import numpy as np
import src
assert src.OTHER == 1  # the user's own
from lightfield_events import Runtime, layout, load, read_events, simulate, voxel_grid, write_video
import lightfield_events
assert lightfield_events.__file__.startswith(sys.argv[1]), lightfield_events.__file__
if numba.config.DISABLE_JIT:
    from lightfield_events.src.sim.sensor.engines import sensor_cpu
    sensor_cpu.simulate_pixel_blocks = lambda *_: False  # no Python: no events
frames = np.random.default_rng(0).uniform(0.1, 0.9, (3, 24, 32))
clip = simulate(frames, "strong", 9, fps=60)
events = np.load(sys.argv[2])
net = load("setnet_small")
runtime = Runtime(net, positions=layout(9), height=24, width=32, form="float32", threads=1)
columns = [events[name] for name in ("t", "x", "y", "p", "view")]
columns[0] = columns[0] * 1e-6
frame = runtime.step(*columns, 0.0, 1 / 120)
grid = voxel_grid(*columns[:4], t0=0.0, t1=1 / 120, bins=5, height=24, width=32)
write_video("a.mp4", clip.clean, fps=30)
np.savez("out.npz", frame=frame, events=len(clip.events), grid=grid.numpy(), views=clip.views)
assert lightfield_events.OnnxNetwork and "onnxruntime" not in sys.modules
left = {name.split(".")[0] for name in sys.modules} & {"conf", "weights", "baselines"}
assert not left and sys.modules["src"] is src and "src.models" not in sys.modules
"""
COLUMNS = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.int8, "view": np.uint16}


def made_events() -> np.ndarray:
    rng, events = np.random.default_rng(0), np.empty(200, list(COLUMNS.items()))
    events["t"] = np.sort(rng.integers(0, 8000, 200))
    for name, most in (("x", 32), ("y", 24), ("view", 9)):
        events[name] = rng.integers(0, most, 200)
    events["p"] = rng.choice([-1, 1], 200)
    return events


def check_package(place: Path, folder: Path, compiled: bool) -> None:
    """Use the package at `place` from `folder`, where another src lies, and compare the result.

    To compile its kernels takes half a minute; otherwise they are plain Python, without events.
    """
    (folder / "src").mkdir()
    (folder / "src" / "__init__.py").write_text("OTHER = 1\n")
    np.save(folder / "events.npy", events := made_events())
    path = os.pathsep.join([str(place), sysconfig.get_paths()["purelib"]])
    # One thread on both sides: sums of two are rounded otherwise.
    environment = os.environ | {"PYTHONPATH": path, "NUMBA_DISABLE_JIT": str(int(not compiled))}
    environment["OMP_NUM_THREADS"] = "1"
    command = [sys.executable, "-W", "ignore", "-c", USE, str(place), "events.npy"]
    subprocess.run(command, cwd=folder, env=environment, check=True, timeout=600)
    with np.load(folder / "out.npz") as found, torch_threads(1):
        net, columns = files.load("setnet_small"), [events[name] for name in COLUMNS]
        columns[0] = columns[0] * 1e-6
        size = {"height": 24, "width": 32, "form": "float32", "threads": 1}
        runtime = EventListRuntime(net, positions=lightfield_events.layout(9), **size)
        assert np.array_equal(found["frame"], runtime.step(*columns, 0.0, 1 / 120))
        assert found["grid"].sum() == pytest.approx(events["p"].sum())
        assert found["events"] > 100 or not compiled
        assert found["views"].shape == (9, 3, 24, 32) and found["views"].std(0).mean() > 0.01
    assert (folder / "a.mp4").stat().st_size > 200


def test_the_built_package_works_beside_another_src(tmp_path):
    build = [sys.executable, "-W", "ignore", "setup.py", "-q", "build_py", "-d", f"{tmp_path}/p"]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=300)
    package = tmp_path / "p" / "lightfield_events"
    assert sorted(entry.name for entry in (tmp_path / "p").iterdir()) == ["lightfield_events"]
    assert (package / "py.typed").is_file() and (package / "weights/lf3x3.safetensors").is_file()
    for file in package.rglob("*.py"):
        assert not re.search(r"^\s*(from|import) (src|baselines)\b", file.read_text(), re.M), file
    (tmp_path / "user").mkdir()
    check_package(tmp_path / "p", tmp_path / "user", compiled=False)


def copy_tree(tmp_path: Path) -> Path:
    tree = tmp_path / "tree"  # pip leaves files where it builds
    for name in ("src", "baselines", "conf", "weights", "lightfield_events"):
        shutil.copytree(ROOT / name, tree / name)
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, tree / name)
    return tree


@pytest.mark.slow
def test_the_editable_installation_of_make_works_in_any_folder(tmp_path):
    tree, place = copy_tree(tmp_path), tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place], check=True)
    (site,) = place.glob("lib/python*/site-packages")
    (site / "packages.pth").write_text(sysconfig.get_paths()["purelib"])
    python, asked = place / "bin" / "python", (ROOT / "scripts" / "setup.sh").read_text()
    (options,) = re.findall(r"(--no-deps --no-build-isolation --editable \.)$", asked, re.M)
    install = [python, "-m", "pip", "install", "--quiet", "--no-index", *options.split()]
    subprocess.run(install, cwd=tree, check=True, capture_output=True, timeout=300)
    code = "import lightfield_events as l; print(l.__file__); l.layout"
    done = subprocess.run([python, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.strip() == str(tree / "lightfield_events/__init__.py")


@pytest.mark.slow
def test_pip_installs_it_into_an_empty_folder(tmp_path):
    tree = copy_tree(tmp_path)
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--target", str(tmp_path / "p")]
    command = [sys.executable, "-m", "pip", "install", ".", *options]
    subprocess.run(command, cwd=tree, check=True, capture_output=True, timeout=600)
    names = {entry.name for entry in (tmp_path / "p").iterdir()}
    assert not names & {"src", "conf", "baselines", "weights"}
    (tmp_path / "user").mkdir()
    check_package(tmp_path / "p", tmp_path / "user", compiled=True)


def test_commands_without_their_packages_say_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["lightfield-events", "simulate"])
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    monkeypatch.setattr(lightfield_events.__main__, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="1"):
        lightfield_events.__main__.main()
    said = 'error: commands need pip install ".[train]" in the folder of the repository\n'
    assert capsys.readouterr().err == said


def test_imports_are_renamed_and_nothing_else():
    text = "from src.app import a\n    from src import models\nimport src.sim\nx = 'from src.app'\n"
    renamed = rename_imports(text + "from srcs import b\nimport baselines\n")
    assert renamed.splitlines() == [
        "from lightfield_events.src.app import a",
        "    from lightfield_events.src import models",
        "import lightfield_events.src.sim; from lightfield_events import src",
        "x = 'from src.app'",
        "from srcs import b",
        "import lightfield_events.baselines; from lightfield_events import baselines",
    ]


def test_every_public_name_is_there():
    for name in lightfield_events.__all__:
        assert getattr(lightfield_events, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'lod'"):
        lightfield_events.lod  # noqa: B018
