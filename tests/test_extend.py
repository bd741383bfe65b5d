"""docs/extend.md is followed to the letter in a copy of the repository: its files, its commands."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT

SMALL = ["scene.height=64", "scene.width=64", "data.test_windows=4", "data.test_crop=32"]
SCORED = [
    *SMALL,
    "data.test_clips=2",
    "data.unscored_windows=1",
    "data.workers=0",
    "metrics.lpips=null",
]
TINY = {  # what is added to a command, so that it is over in seconds
    "train": ["debug=fdr", "loss=l1", "metrics.lpips=null", "logger=none"],
    "eval": SCORED,
    "simulate": SMALL,
    "reconstruct": ["fps=1000", "hydra.run.dir=out/digit", "output_format=hdf5"],
    "report": [],
}
OWN_KEYS = {  # of classes of one's own, with names that keys of this repository once had
    "turbulence=shimmer": ["turbulence.rms_px=3"],
    "scene=snow": ["++scene.speed=1"],
}
STEP = re.compile(r"(New|In) `([^`]+)`(?:, below `([^`]+)`)?:\n\n```\w+\n(.*?)```", re.S)
DRIVER = """
import json, runpy, sys
for line in json.load(open("commands.json")):
    sys.argv = [line[2], *line[3:]]
    try:
        runpy.run_module(line[2], run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code:
            sys.exit(f"{line}: {end.code}")
"""


@pytest.fixture(scope="module")
def page() -> str:
    return (ROOT / "docs" / "extend.md").read_text()


@pytest.fixture(scope="module")
def copy(tmp_path_factory, page) -> Path:
    """A copy of the repository in which all that the page says is done."""
    copy = tmp_path_factory.mktemp("copy")
    for folder in ("src", "baselines", "conf"):
        shutil.copytree(ROOT / folder, copy / folder)  # with what numba has compiled
    for kind, name, line, text in STEP.findall(page):
        path = copy / name
        if kind == "New":
            assert not path.exists(), name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        else:
            lines = path.read_text().splitlines(keepends=True)
            (at,) = [k for k, there in enumerate(lines) if there.strip() == line]
            path.write_text("".join([*lines[: at + 1], text, *lines[at + 1 :]]))
    (copy / "mypackage" / "__init__.py").touch()
    digit = np.array([[k % 34, (3 * k) % 34, (k % 2) << 7, k >> 8, k & 255] for k in range(4000)])
    (copy / "digit.bin").write_bytes(digit.astype(np.uint8).tobytes())
    return copy


def commands(page: str) -> list[list[str]]:
    """The commands of the page, made small."""
    page = page.replace("\\\n", " ")
    lines = [
        line for block in re.findall(r"```sh\n(.*?)```", page, re.S) for line in block.split("\n")
    ]
    words = [line.split() for line in lines if line]
    own = [[key for word in line for key in OWN_KEYS.get(word, [])] for line in words]
    return [
        [*line, *TINY[line[2].removeprefix("src.")], *keys]
        for line, keys in zip(words, own, strict=True)
    ]


def test_the_page_is_followed(copy, page):
    (copy / "commands.json").write_text(json.dumps(commands(page)))
    (copy / "driver.py").write_text(DRIVER)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(copy)}
    run = [sys.executable, "-W", "ignore", "driver.py"]
    done = subprocess.run(run, cwd=copy, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    scored = json.loads((copy / "out" / "contrast" / "results.json").read_text())
    assert scored["test"]["contrast"]["mean"] > 0 and scored["own_metrics"] == {"contrast": 0}
    assert "contrast" in (copy / "out" / "contrast" / "clips.csv").read_text().split("\n")[0]
    (report,) = (copy / "out" / "report").rglob("report.md")
    assert report.read_text().count("baseline.decay") >= 1
    (frames,) = (copy / "out" / "digit").glob("frames.csv")
    assert len(frames.read_text().splitlines()) == 5  # four windows of a millisecond


def test_every_addition_is_short(page):
    for kind, name, _, text in STEP.findall(page):
        code = [line for line in text.splitlines() if line.strip()]
        assert len(code) <= (20 if "turbulence" not in name and "shimmer" not in name else 40), name
        assert kind == "New" or len(code) == 1
