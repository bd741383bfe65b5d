"""Every code block of docs/python.md, and every cell of docs/notebooks, runs, in order, in one
namespace; and does what it says.
"""

import importlib.util
import json
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import lightfield_events
from src.deploy.onnx_export import PACKAGES
from src.recordings.files import videos
from src.recordings.files.event_writers import write_events
from src.recordings.output import write_video
from src.sim.optics import layout
from src.sim.voxel import voxel_grid
from tests.conftest import ROOT
from tests.test_docs import BANNED, LINE, LINK
from tests.test_entry_points import run_here
from tests.test_simulate_user_clip import textured

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LARGEST_BYTES = 400_000
SMALLER = {  # what a notebook says, and what is run here: seconds instead of minutes
    "SECONDS = 0.4": "SECONDS = 0.1",
    "SIDE_PX = 256": "SIDE_PX = 96",
    "FILM_S = 2.0": "FILM_S = 0.5",
    "longest_side_px=160": "longest_side_px=96",
    "END_S = 0.24": "END_S = 0.1",
    "STEPS = 40": "STEPS = 1",
    "CLIPS = 12": "CLIPS = 2",
    "SIDE_PX = 128": "SIDE_PX = 64",
    "data.test_windows=20": "data.test_windows=8",
}


def blocks() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs/python.md").read_text(), re.M | re.S)


def test_the_page_runs_as_it_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "my.mp4", textured(16, (40, 56)), fps=30)
    events = np.zeros(300, [("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])
    events["t"], events["p"] = np.arange(300) * 50, 1
    for name in ("cap.csv", "left.csv", "right.csv"):
        write_events(tmp_path / name, events, width=64, height=48)
    assert len(blocks()) >= 7
    space: dict = {}
    has_onnx = all(map(importlib.util.find_spec, PACKAGES))
    for block in blocks():
        if has_onnx or "export_onnx" not in block:
            exec(compile(block, "docs/python.md", "exec"), space)
    if has_onnx:
        assert np.abs(np.stack(space["written"]) - np.stack(space["frames"][:2])).max() < 1e-3
    clip, frames, fast = (space[name] for name in ("clip", "frames", "fast"))
    assert (
        clip.fps == 30 and clip.clean.shape == (15, 40, 56) and clip.drawn["severity"] == "strong"
    )
    assert space["still"].tilt.shape == (1, 13, 2, 64, 96) and space["film"].fps == 60
    assert len(space["often"]) == 16 and space["often"][-1].std() > 0.01
    arrived = space["arrived"]
    assert len(arrived) >= 48 and (np.stack(arrived[:48]) == np.stack(fast)).all()
    assert len(frames) == len(fast) == 48 and frames[-1].std() > 0.01
    joined = lightfield_events.read_events(tmp_path / "array.npz")
    assert len(joined) == 600 and (joined["t"][0], joined["x"][0]) == (-1250, 64)
    assert np.abs(np.stack(frames) - np.stack(fast)).max() < 0.1  # bf16 or float32
    assert len(list(videos.read_video(tmp_path / "film.mp4"))) == 48
    assert len(space["recorded"]) == 300


class GridRuntime:
    """A stand-in for Runtime: the grids of the events that it is given."""

    def __init__(self, net, *, positions, height, width):
        self.views, self.size = len(positions), {"bins": 5, "height": height, "width": width}

    def step(self, t, x, y, p, view, t0: float, t1: float) -> np.ndarray:
        assert not len(t) or t0 <= t[0] <= t[-1] <= t1
        mine = [tuple(part[view == k] for part in (t, x, y, p)) for k in range(self.views)]
        return np.stack([voxel_grid(*part, t0=t0, t1=t1, **self.size) for part in mine])


def test_the_lists_of_the_page_are_its_grids(monkeypatch):
    """Of events at both edges of every window, some of which are rounded in seconds."""
    monkeypatch.setattr(lightfield_events, "Runtime", GridRuntime)
    edges_us = np.ceil(np.arange(49) * 1e6 / 120).astype(np.int64)
    t = np.sort(np.concatenate([edges_us, edges_us[1:] - 1, np.arange(0, 400_000, 700)]))
    names = [("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8), ("view", int)]
    events = np.zeros(len(t), names)
    events["t"], events["x"], events["p"], events["view"] = t, t % 7, 1 - t % 2 * 2, t % 9
    clip = SimpleNamespace(positions=layout(9))
    space = {"events": events, "clean": np.zeros((1, 8, 8)), "clip": clip, "net": None}
    space |= {"np": np}
    for words in ("def grid", "def step"):
        (block,) = (block for block in blocks() if words in block)
        exec(compile(block, "docs/python.md", "exec"), space)
    grids = [[space["grid"](k, view) for view in range(9)] for k in range(48)]
    np.testing.assert_allclose(np.stack(space["fast"]), grids, atol=1e-4)


@pytest.mark.parametrize("clock_us", [3_600_000_000, 1_800_000_000_000_000])
def test_the_frames_of_chunks_begin_with_the_first_event(clock_us):
    names = [("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8), ("view", int)]
    events, steps = np.zeros(100, names), []
    events["t"] = clock_us + 1000 * np.arange(100)
    (block,) = (block for block in blocks() if "def frames_of" in block)
    space = {"events": events, "np": np, "window_us": 1e6 / 120}
    space |= {"runtime": SimpleNamespace(reset=lambda: None)}
    space["step"] = lambda part, start, end: steps.append((len(part), start, end))
    exec(compile(block, "docs/python.md", "exec"), space)
    assert 11 <= len(steps) == len(space["arrived"]) <= 12
    assert steps[0][0] and 0 <= clock_us - steps[0][1] < 1e6 / 120
    assert sum(count for count, *_ in steps) >= 91


def cells(notebook, kind: str) -> list[dict]:
    return [c for c in json.loads(notebook.read_text())["cells"] if c["cell_type"] == kind]


@pytest.fixture
def run_notebook(tmp_path, monkeypatch, capfd):
    """Run the code cells of the notebook of a name, made small; return their namespace."""

    def run_command(words, **options):  # in this process, which has imported PyTorch
        if words[1] != "-m":
            return ordinary(words, **options)
        capfd.readouterr()
        code = run_here(words[2].removeprefix("src."), *words[3:])
        return subprocess.CompletedProcess(words, code, *capfd.readouterr())

    ordinary = subprocess.run
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(subprocess, "run", run_command)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(ROOT / "docs" / "notebooks")

    def run(name: str) -> dict:
        (notebook,) = (path for path in NOTEBOOKS if path.stem == name)
        space: dict = {}
        for number, cell in enumerate(cells(notebook, "code")):
            code = "".join(cell["source"])
            for large, small in SMALLER.items():
                code = code.replace(large, small)
            code = code.replace('Path("out/notebooks', f'Path("{tmp_path}')
            if "IPython" not in code or importlib.util.find_spec("IPython"):
                exec(compile(code, f"{name}, code cell {number}", "exec"), space)
        return space

    yield run
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")


def test_the_notebook_that_simulates(run_notebook):
    found = run_notebook("1_simulate")
    assert found["views"].shape == (9, 13, 64, 96) and len(found["events"]) > 1000
    assert 0.1 < found["tilt"].std() < 0.6
    measured = found["mine"].drawn["tilt_px"]
    assert 0.2 < measured / found["site"].tilt.std() < 5 and (found["OUT"] / "air.yaml").is_file()
    assert abs(found["mine"].views[0] - found["mine"].clean).mean() > 0.005


def test_the_notebook_that_reconstructs(run_notebook):
    found = run_notebook("2_reconstruct")
    one, nine = found["one"], found["nine"]
    assert len(found["events"]) == 59197 and one.shape == nine.shape == (12, 128, 128)
    assert abs(one - nine).mean() > 0.01 and np.ptp(nine[-1]) > 0.9  # tone=auto


def test_the_notebook_that_trains(run_notebook):
    found = run_notebook("3_train_for_your_site")
    records = {name: json.loads((found["OUT"] / name / "results.json").read_text())
               for name in ("trained", "shipped")}  # fmt: skip
    means = {name: record["test"]["psnr_aligned"]["mean"] for name, record in records.items()}
    gain = means["trained"] - means["shipped"]
    assert len(found["won"]) == 2 and gain != 0
    assert np.mean(found["won"]) == pytest.approx(gain, abs=1e-6)
    assert f"| {gain:+.3f} |" in (found["OUT"] / "report" / "report.md").read_text()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_started_elsewhere_says_so(notebook, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, space = "".join(cells(notebook, "code")[0]["source"]), {}
    with pytest.raises(SystemExit, match="^start it in the folder of the repository, not in /"):
        exec(compile(first, notebook.stem, "exec"), space)


def test_every_setting_that_is_made_small_is_in_a_notebook():
    text = "".join("".join(cell["source"]) for n in NOTEBOOKS for cell in cells(n, "code"))
    assert len(NOTEBOOKS) == 3 and [large for large in SMALLER if large not in text] == []


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_short_and_shows_what_it_draws(notebook):
    code, prose = cells(notebook, "code"), cells(notebook, "markdown")
    assert 6 <= len(code) + len(prose) <= 13 and notebook.stat().st_size < LARGEST_BYTES
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    kinds = [kind for cell in code for out in cell["outputs"] for kind in out.get("data", ())]
    assert kinds.count("image/jpeg") >= 2
    assert not [o for c in code for o in c["outputs"] if o.get("name") == "stderr"]
    text = "\n".join("".join(cell["source"]) for cell in prose)
    assert [line for line in text.splitlines() if len(line) > LINE and line[0] != " "] == []
    assert [word for word in BANNED if re.search(word, text, re.I)] == []
    links = [link.partition("#")[0] for link in LINK.findall(text)]
    assert links and [link for link in links if not (notebook.parent / link).exists()] == []
