"""src.train and src.eval on every config, at a tiny size; resuming; wrong values."""

import json
import time
from itertools import zip_longest
from pathlib import Path
from unittest.mock import Mock, call

import pytest
import torch
from hydra import compose, initialize_config_dir
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import DictConfig
from PIL import Image

from src.app import entry_point
from src.eval import evaluate
from src.recordings.files.recording import read_events
from src.simulate import simulate
from src.train import fit, train
from tests.conftest import ROOT

TINY = ["debug=fdr", "~callbacks.progress", "loss=l1", "metrics.lpips=null"]
# Where the scores do not matter: testing takes longer than one step.
LEAN = ["reference_baseline=null", "data.test_windows=2", "data.unscored_windows=0"]
UNDRAWN = [*LEAN, "sample_clips=0"]


def config(name: str, run: Path, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        cfg = compose(name, list(overrides))
    cfg.paths.out = cfg.paths.run = str(run)
    return cfg


def names(group: str) -> list[str]:
    folder = ROOT / "conf" / group
    return sorted(str(f.relative_to(folder).with_suffix("")) for f in folder.rglob("*.yaml"))


@pytest.mark.parametrize("experiment", names("experiment"))
def test_every_experiment_takes_a_step(experiment, tmp_path):
    train(config("train", tmp_path, f"experiment={experiment}", *TINY, *LEAN))
    record = json.loads((tmp_path / "results.json").read_text())
    assert record["experiment"] == experiment and record["schema"] == 1
    assert record["test"]["clips"] == 1 and 0 <= record["test"]["ssim"]["mean"] <= 1
    assert record["model"]["params"] > 1000 and record["model"]["macs_per_frame"] > 1000
    assert (tmp_path / "checkpoints" / "last.ckpt").is_file()
    assert list((tmp_path / "samples").glob("*.gif")) and list((tmp_path / "samples").glob("*.png"))


def test_weights_and_biases_holds_config_pictures_and_metrics(tmp_path):
    train(config("train", tmp_path, *TINY, *LEAN, "experiment=single256", "logger=wandb"))
    entry_point.finish_wandb()
    (run,) = (tmp_path / "wandb").glob("offline-run-*")
    words, late = (b"test/psnr_aligned", b"train/loss", b"epoch_clips"), time.monotonic() + 60
    while not all(word in next(run.glob("*.wandb")).read_bytes() for word in words):
        assert time.monotonic() < late, "W&B's process has not written all"
        time.sleep(0.2)
    pictures = [file.suffix for file in run.rglob("media/**/*") if file.is_file()]
    assert sorted(set(pictures)) == [".gif", ".png"]


@pytest.mark.parametrize("debug", [name for name in names("debug") if name != "default"])
def test_every_debug_preset_takes_a_step(debug, tmp_path):
    small = ["trainer.max_steps=1", "data.epoch_clips=1", "data.batch_size=1", "data.test_clips=1"]
    small += [
        "scene.height=64",
        "scene.width=64",
        "data.crop=32",
        "data.windows=2",
        "data.loss_from=0",
    ]
    small += ["data.val_clips=1", "width=4", "trainer.log_every_n_steps=1"]
    train(config("train", tmp_path, f"debug={debug}", *TINY[1:], *small, *UNDRAWN))
    assert (tmp_path / "results.json").is_file()


GROUPS = ["budget", "logger", "loss", "trainer", "optics", "turbulence", "sensor"]


def test_every_choice_composes(tmp_path):
    """One of each group at a time."""
    choices = [[f"{group}={choice}" for choice in names(group)] for group in GROUPS]
    for chosen in zip_longest(*choices):
        cfg = config("train", tmp_path, *filter(None, chosen))
        assert cfg.name == "lf3x3"


def test_resuming_equals_not_having_stopped(tmp_path):
    steps = [*UNDRAWN, "experiment=single256", "data.epoch_clips=2"]
    steps += ["augment.noise_std=0.1", "scheduler.T_max=5"]
    whole, first, second = (tmp_path / name for name in ("whole", "first", "second"))
    train(config("train", whole, *TINY, *steps, "trainer.max_steps=5"))
    train(config("train", first, *TINY, *steps, "trainer.max_steps=3"))
    ckpt = first / "checkpoints" / "last.ckpt"
    logs = (first / "logs" / "metrics.csv").read_text()
    train(config("train", second, *TINY, *steps, "trainer.max_steps=5", f"ckpt={ckpt}"))
    one = torch.load(whole / "checkpoints" / "last.ckpt", weights_only=True)
    two = torch.load(second / "checkpoints" / "last.ckpt", weights_only=True)
    assert one["global_step"] == two["global_step"] == 5
    for name, value in one["state_dict"].items():
        assert torch.equal(value, two["state_dict"][name]), name
    assert (first / "logs" / "metrics.csv").read_text() == logs


def test_the_same_seed_gives_the_same_loss_curve(tmp_path):
    curves, steps = [], [*UNDRAWN, "experiment=single256", "trainer.max_steps=2"]
    for run in ("a", "b"):
        train(config("train", tmp_path / run, *TINY, *steps, "data.epoch_clips=2"))
        curves.append((tmp_path / run / "logs" / "metrics.csv").read_text())
    assert curves[0] == curves[1]


def test_eval_equals_the_test_of_training(tmp_path):
    train(config("train", tmp_path / "train", *TINY))
    ckpt = tmp_path / "train" / "checkpoints" / "last.ckpt"
    same = [f"ckpt={ckpt}", "scene.height=72", "scene.width=72", "data.test_clips=1"]
    same += [
        "data.test_windows=4",
        "data.unscored_windows=1",
        "data.workers=0",
        "metrics.lpips=null",
    ]
    evaluate(config("eval", tmp_path / "eval", *same))
    first, second = (
        json.loads((tmp_path / entry_point / "results.json").read_text())["test"]
        for entry_point in ("train", "eval")
    )
    assert first == second


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["scene.root=/nowhere"], "scene.root"),
        (["data.crop=100"], "data.crop"),
        (["data.batch_size=0"], "data.batch_size"),
        (["data.unscored_windows=9", "data.test_windows=10"], "data.unscored_windows"),
        (["optics.views=7"], "optics.views"),
        (["sensor.threshold=-1"], "sensor.threshold"),
        (["augment.pause_probability_when_running=2"], "augment.pause_probability_when_running"),
        (["data.simulate_on=moon"], "data.simulate_on"),
        (["paths.out=/dev/null/x"], "paths.out"),
        (["teachers=lf3x3", "distillation_cache=/dev/null/x"], "distillation_cache"),
        (["scene._target_=os.system"], "_target_"),
        (["ckpt=/nowhere.ckpt"], "ckpt"),
    ],
)
def test_a_wrong_value_names_its_key(overrides, key, tmp_path):
    cfg = config("train", tmp_path, *TINY, *[o for o in overrides if not o.startswith("paths")])
    if key == "paths.out":
        cfg.paths.run = "/dev/null/x"
    with pytest.raises(ValueError, match=key):
        train(cfg)


def test_a_training_that_takes_no_step_is_refused(tmp_path):
    cfg = config("train", tmp_path, *TINY, "+trainer.limit_train_batches=0")
    with pytest.raises(ValueError, match="limit_train_batches and train_hours must let"):
        train(cfg)
    assert not (tmp_path / "results.json").exists()


@pytest.mark.parametrize("is_there", [True, False])
def test_several_processes_store_in_the_folder_of_the_first_and_all_or_none(is_there, tmp_path):
    """As under torchrun, which gives each process a folder of its own."""

    def train_in_the_folder_of_the_first(*_, **__) -> None:
        trainer.checkpoint_callback.dirpath = str(tmp_path / "first")

    trainer = Mock(checkpoint_callback=Mock(spec=ModelCheckpoint, dirpath=str(tmp_path / "own")))
    trainer.fit.side_effect = train_in_the_folder_of_the_first
    trainer.strategy.broadcast.side_effect = lambda _: not is_there  # what the first says
    fit(trainer, Mock(steps_so_far=1), Mock(), None)
    stored = [] if is_there else [call(tmp_path / "first" / "last.ckpt")]
    assert trainer.save_checkpoint.call_args_list == stored


@pytest.mark.parametrize("turbulence", ["none", "strong"])
def test_simulate_draws_the_views_and_writes_a_recording(turbulence, tmp_path):
    small = ["data.test_windows=3", "data.test_crop=32", f"turbulence={turbulence}"]
    cfg = config("simulate", tmp_path, *small, f"write={tmp_path / 'cap.raw'}")
    drawn = simulate(cfg)
    assert drawn["severity"] == turbulence and (tmp_path / "views.gif").stat().st_size > 1000
    assert (tmp_path / "views.png").is_file()
    assert len(read_events(tmp_path / "cap.raw")) > 100
    assert (tmp_path / "cap.views.yaml").is_file() and (tmp_path / "cap.truth.h5").is_file()


def test_the_film_of_a_long_clip_of_nine_views_is_small(tmp_path):
    cfg = config("simulate", tmp_path, "data.test_windows=25", "turbulence=weak")
    simulate(cfg)
    with Image.open(tmp_path / "views.gif") as film:
        assert film.n_frames == 24 and film.size[0] <= 972
    assert (tmp_path / "views.gif").stat().st_size < 5e6
