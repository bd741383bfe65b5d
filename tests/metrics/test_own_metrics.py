"""A metric of a package of one's own: its scores of clips, their mean, and how it is refused."""

import csv
import sys

import pytest
import torch
from torchmetrics import MeanSquaredError, Metric

from src.eval import evaluate
from src.metrics.video_metrics import VideoMetrics
from src.report import report
from src.train import train
from tests.metrics.test_video_metrics import clip
from tests.test_train import TINY, config

OWN = """
import torch
from torchmetrics import Metric

class Dark(Metric):
    higher_is_better, full_state_update = {better}, False

    def __init__(self, level: float = 0.5):
        super().__init__()
        self.level = level
        self.add_state("share", torch.tensor(0.0), "sum")

    def update(self, frames, target):
        assert frames.shape == target.shape and frames.ndim == 4
        self.share += (frames - target < self.level).float().mean()

    def compute(self):
        return self.share

class NoMetric:
    pass
"""
ADDED = "+metrics.dark._target_={package}.dark.Dark"
SMALL = [
    "baseline=highpass", "scene.height=64", "scene.width=64", "data.test_windows=4",
    "data.test_crop=32", "data.test_clips=3", "data.unscored_windows=1", "data.workers=0",
    "metrics.lpips=null", "~trainer.plugins", "trainer.enable_progress_bar=false",
]  # fmt: skip


@pytest.fixture
def package(tmp_path, monkeypatch) -> str:
    """The name of a package whose module `dark` is OWN."""
    name = f"package_of_{tmp_path.name}"
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").touch()
    (tmp_path / name / "dark.py").write_text(OWN.format(better=False))
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def test_it_scores_clips_and_has_a_column_with_an_arrow(package, tmp_path):
    asked = [ADDED.format(package=package), "+metrics.dark.level=0.1"]
    asked.append(f"allowed_packages=[{package}]")
    record = evaluate(config("eval", tmp_path / "runs" / "a", *SMALL, *asked))
    rows = list(csv.DictReader((tmp_path / "runs" / "a" / "clips.csv").read_text().splitlines()))
    values = [float(row["dark"]) for row in rows]
    assert len(values) == 3 and all(0.1 < value < 1 for value in values)
    assert record["test"]["dark"]["mean"] == pytest.approx(sum(values) / 3)
    assert record["own_metrics"] == {"dark": -1}
    other = evaluate(config("eval", tmp_path / "runs" / "b", *SMALL, "seed=1", *asked))
    found = {t.title: t for t in report(config("report", tmp_path / "o", f"run={tmp_path}/runs"))}
    table = found["Scores and cost"]
    place = [column.title for column in table.columns].index("dark ↓")
    assert table.rows[0][place].mean == pytest.approx(
        (record["test"]["dark"]["mean"] + other["test"]["dark"]["mean"]) / 2
    )
    pair = [f"run={tmp_path}/runs/a", f"against={tmp_path}/runs/a"]
    found = {t.title: t for t in report(config("report", tmp_path / "p", *pair))}
    lines = {row[0].text: row[3].text for row in found["Differences on the same clips"].rows}
    assert lines["dark"] == "+0.0000"


def test_a_training_scores_with_it_and_keeps_it_out_of_the_checkpoint(package, tmp_path):
    asked = [ADDED.format(package=package), f"allowed_packages=[{package}]"]
    record = train(config("train", tmp_path / "run", *TINY, *asked))
    everything = [record["test"], *record["compared"].values()]
    assert len(everything) >= 3 and all(0 < found["dark"]["mean"] <= 1 for found in everything)
    saved = torch.load(tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=True)
    assert not [key for key in saved["state_dict"] if "dark" in key]


def test_its_value_is_that_of_each_clip_alone():
    class Root(MeanSquaredError):
        full_state_update = False

    metrics = VideoMetrics(own={"rmse": Root(squared=False)})
    for seed in range(3):
        frames, target = clip(seed)
        wanted = (frames - target).square().mean().sqrt().item()
        assert metrics(frames, target)["rmse"] == pytest.approx(wanted, rel=1e-5)
    assert metrics.names[-1] == "rmse" and metrics.user_metric_columns[0].title == "rmse ↓"


class Several(Metric):
    full_state_update = False

    def update(self, frames, target):
        pass

    def compute(self):
        return {"a": torch.tensor(1.0)}


def test_a_metric_of_several_values_is_refused():
    with pytest.raises(ValueError, match=r"metrics\.pair must compute a tensor of numbers, got di"):
        VideoMetrics(own={"pair": Several()})(*clip())


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["+metrics.dark._target_={package}.dark.Dark"], "allowed_packages=[<package>]"),
        (
            ["+metrics.dark._target_={package}.dark.NoMetric", "allowed_packages=[{package}]"],
            "metrics.dark._target_ must be a torchmetrics.Metric, got {package}.dark.NoMetric",
        ),
        (
            ["+metrics.psnr._target_={package}.dark.Dark", "allowed_packages=[{package}]"],
            "metrics.psnr must be called otherwise: the name is taken",
        ),
        (
            ["+metrics.severity._target_={package}.dark.Dark", "allowed_packages=[{package}]"],
            "metrics.severity must be called otherwise: a parameter of the clips has that name",
        ),
        (
            ["data=evreal", "+metrics.dark._target_={package}.dark.Dark"],
            "data=evreal has the metrics of its protocol only, got metrics.dark",
        ),
    ],
)
def test_what_is_refused(asked, said, package, tmp_path):
    keep = slice(1) if asked[0] == "data=evreal" else slice(None)
    lines = [*SMALL[keep], *(line.format(package=package) for line in asked)]
    with pytest.raises(ValueError) as error:
        evaluate(config("eval", tmp_path / "run", *lines))
    assert said.format(package=package) in str(error.value)
