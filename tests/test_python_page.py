"""Every code block of docs/python.md runs, in order, in one namespace; and does what it says."""

import re

import numpy as np

from src.recordings.files import videos
from src.recordings.files.event_writers import write_events
from src.recordings.output import write_video
from tests.conftest import ROOT
from tests.test_simulate_own import textured


def blocks() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs/python.md").read_text(), re.M | re.S)


def test_the_page_runs_as_it_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "my.mp4", textured(16, (40, 56)), fps=30)
    events = np.zeros(300, [("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])
    events["t"], events["p"] = np.arange(300) * 50, 1
    write_events(tmp_path / "cap.csv", events, width=64, height=48)
    assert len(blocks()) >= 7
    space: dict = {}
    for block in blocks():
        exec(compile(block, "docs/python.md", "exec"), space)
    clip, frames, fast = (space[name] for name in ("clip", "frames", "fast"))
    assert (
        clip.fps == 30 and clip.clean.shape == (15, 40, 56) and clip.drawn["severity"] == "strong"
    )
    assert space["still"].tilt.shape == (1, 13, 2, 64, 96) and space["film"].fps == 60
    assert len(frames) == len(fast) == 48 and frames[-1].std() > 0.01
    assert np.abs(np.stack(frames) - np.stack(fast)).max() < 0.1  # bf16 or float32
    assert len(list(videos.read_video(tmp_path / "film.mp4"))) == 48
    assert len(space["recorded"]) == 300
