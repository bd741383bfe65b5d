"""docs/extend.md is followed to the letter in a copy of the repository: its files, its commands."""

import importlib
import json
import os
import re
import runpy
import shutil
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.configs import remember_configs
from tests.conftest import ROOT
from tests.faults.harness import Run, leave_slices_out

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


def follow(copy: Path, lines: list[list[str]]) -> None:
    """Run commands with the modules of the copy, in a process that has those of this repository."""
    left = [name for name in sys.modules if name.split(".")[0] in ("src", "baselines")]
    for name in left:
        del sys.modules[name]
    sys.meta_path[:] = [finder for finder in sys.meta_path if "jaxtyping" not in str(finder)]
    sys.path.insert(0, str(copy))
    os.chdir(copy)
    warnings.simplefilter("ignore")
    remember_configs(pytest.MonkeyPatch())
    samples = importlib.import_module("src.figures.samples")
    assert Path(samples.__file__).is_relative_to(copy)
    samples.draw_comparison = leave_slices_out
    for line in lines:
        sys.argv = [line[2], *line[3:]]
        try:
            runpy.run_module(line[2], run_name="__main__", alter_sys=True)
        except SystemExit as end:
            if end.code:
                sys.exit(f"{line}: {end.code}")


def test_the_page_is_followed(copy, page):
    run = Run(copy / "log.txt", follow, copy, commands(page))
    assert run.wait() == 0, run.text()[-4000:]
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
