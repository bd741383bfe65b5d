"""The README's commands: all are run, tiny, one after the other, but those that are only composed.

Composed only, as tests of their own run them: src.live, and the commands of the other pages.  Files
that a reader has (my.mp4, cap.raw, board.raw, /data/photographs) are made small.  Targets of `make`
exist.
"""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from src.calibrate import calibrate
from src.eval import evaluate
from src.figures.comparison import draw_comparison
from src.reconstruct import reconstruct
from src.simulate import simulate
from src.train import train
from tests.conftest import ROOT
from tests.recordings.turbulence_measurement.test_turbulence_meter import fields, film
from tests.test_recording_entry_points import folder  # noqa: F401 - a fixture
from tests.test_sweeps import jobs
from tests.test_train import TINY


def evaluate_and_draw(cfg) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("src.figures.samples.draw_comparison", draw_comparison)
        evaluate(cfg)
    slices = Path(cfg.paths.run, "samples").glob("*_slice.png")
    assert [path.stat().st_size > 5000 for path in slices] == [True, True]


SMALL = ["scene.height=64", "scene.width=64", "data.test_windows=4"]
RUN = {  # entry point: what runs it, and what makes it tiny
    "train": (train, [*TINY, "logger=none", "data.cache_clips=null"]),
    "eval": (evaluate_and_draw, [*SMALL, "data.test_clips=2", "data.unscored_windows=1",
                                 "data.workers=0", "metrics.lpips=null"]),
    "simulate": (simulate, [*SMALL, "camera.sensor_size=[360,640]", "camera.tile_px=116"]),
    "reconstruct": (reconstruct, ["end_s=0.05"]),
    "calibrate": (calibrate, []),
}  # fmt: skip
PAGES = (
    "README.md", "docs/chart.md", "docs/evaluate.md", "docs/recordings.md", "docs/results.md",
    "docs/tables.md", "docs/training.md",
)  # fmt: skip


def commands(page: str) -> list[list[str]]:
    """The words of every command in the indented blocks of a page, its shell variables filled in.

    Raises KeyError for a variable that no line before gives a value.
    """
    text, values, found = (ROOT / page).read_text().replace("\\\n", " "), {}, []
    for line in re.findall(r"^    ((?:python -m src|make|[A-Z]=) ?.*)$", text, re.M):
        line = re.sub(r"\$([A-Z])\b", lambda name, known=dict(values): known[name[1]], line)
        words = shlex.split(line, comments=True)
        if "=" in words[0]:
            values |= dict(word.split("=", 1) for word in words)
        else:
            found.append(words)
    return found


def composed(words: list[str], *more: str):
    """The config that a command asks for."""
    entry_point, given = words[2].removeprefix("src."), list(words[3:])
    place, name, search = ROOT / "conf", entry_point, []
    if "--config-name" in given:
        at = given.index("--config-dir")
        _, place, _, name = given[at : at + 4]
        place, search = ROOT / place, [f"hydra.searchpath=[file://{ROOT / 'conf'}]"]
        del given[at : at + 4]
        given += jobs(place / f"{name}.yaml")[0]
    with initialize_config_dir(str(place), version_base=None):
        return compose(name, [word for word in [*given, *more] if word != "-m"] + search)


@pytest.mark.parametrize("page", PAGES)
def test_every_command_of_a_page_composes(page):
    found = commands(page)
    assert len(found) >= 4
    for words in found:
        if words[0] == "make":
            target = (words[1:] or ["setup"])[0]
            assert f"\n{target}:" in (ROOT / "Makefile").read_text()
        elif "-m" not in words[3:]:  # several jobs: each is one of the others
            words = [re.sub(r"<(\w+)[^>]*>", r"\1", word.split("|")[0]) for word in words]
            assert composed(words) is not None


@pytest.fixture
def reader(folder, tmp_path, monkeypatch) -> Path:  # noqa: F811
    """The folder of a reader who has recordings, videos and photographs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    for name, source in (("board", "board"), ("cap", "dot")):
        (tmp_path / f"{name}.raw").symlink_to(folder / f"{source}.raw")
    site = np.round(255 * film(fields(6, 0.6, 0.5, 16))).astype(np.uint8)
    writer = cv2.VideoWriter("my.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 60, (64, 64), False)
    for frame in np.tile(site[:, :64, :64], (3, 1, 1)):
        writer.write(frame)
    writer.release()
    (tmp_path / "photos").mkdir()
    for k in range(12):
        cv2.imwrite(f"photos/{k}.png", site[k])
    return tmp_path


def test_every_command_of_the_readme_runs(reader):
    ran, trained = [], None
    for number, words in enumerate(commands("README.md")):
        entry_point = words[2].removeprefix("src.") if words[0] == "python" else "make"
        if entry_point not in RUN:
            continue
        words = [re.sub(r"out/\S*<time>", str(trained), word) for word in words]
        words = [word.replace("/data/photographs", str(reader / "photos")) for word in words]
        work, tiny = RUN[entry_point]
        cfg = composed(words, *tiny, f"paths.out={reader}/out")
        cfg.paths.run = str(reader / "out" / str(number))
        work(cfg)
        trained = trained or (cfg.paths.run if entry_point == "train" else None)
        ran.append(entry_point)
    assert set(ran) == set(RUN) and len(ran) == 7
    assert list(reader.rglob("video.gif")) and (reader / "views.yaml").is_file()
