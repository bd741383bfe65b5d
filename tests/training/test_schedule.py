"""Training by time, averaged weights and the learning curve: cut, resumed, lengthened."""

import csv
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from lightning import Trainer
from torch.optim.swa_utils import AveragedModel

from src.app import build
from src.losses.terms import L1Term, TrainingLoss
from src.models import files
from src.models.folding import inference_copy
from src.train import train
from src.training import schedule
from src.training.ema import WeightEMA
from src.training.learning_curve import LearningCurve
from src.training.reconstructor import Reconstructor
from src.training.schedule import CosineSchedule, TrainingClock
from tests.test_train import TINY, UNDRAWN, config

HOUR = 3600.0  # by the clock below every step is one hour


@pytest.fixture(autouse=True, scope="module")
def steps_take_an_hour():
    class Ticks:
        at = 0.0

        def __call__(self) -> float:
            self.at += HOUR
            return self.at

    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(schedule.CLOCKS, "wall", Ticks())
        yield


@pytest.fixture(scope="module")
def three_hours(tmp_path_factory) -> Path:
    """The folder of a training of three hours, exported to now/net.safetensors."""
    folder = tmp_path_factory.mktemp("three")
    run(folder, "train_hours=3", f"export={folder / 'now/net.safetensors'}")
    return folder


RECIPE = [
    "data.epoch_clips=3",
    "data.loss_from=1",
    "grad_clip_norm=0.5",
    "ema_decay=0.9",
    "optimizer.lr=1e-3",
]
RECIPE += ["callbacks.learning_curve.interval_h=3", "trainer.max_steps=-1", "scheduler=null"]
RECIPE += ["trainer.limit_val_batches=0", "augment.noise_std=0.1", "channels_last=true"]
RECIPE += ["experiment=single256", *UNDRAWN]


def run(folder: Path, *overrides: str) -> dict:
    train(config("train", folder, *TINY, *RECIPE, *overrides))
    return checkpoint(folder)


def checkpoint(folder: Path) -> dict:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)


def curve(folder: Path) -> list[list[float]]:
    rows = list(csv.DictReader((folder / "curve.csv").read_text().splitlines()))
    return [
        [float(row[name] or 0) for name in ("hours", "steps", "windows", "ssim")] for row in rows
    ]


def rate(checkpoint: dict) -> float:
    return checkpoint["optimizer_states"][0]["param_groups"][0]["lr"]


def test_a_training_cut_and_resumed_equals_one_left_alone(tmp_path):
    whole = run(tmp_path / "whole", "train_hours=7")
    run(tmp_path / "first", "train_hours=7", "trainer.max_steps=4")
    second = run(tmp_path / "second", "train_hours=7", f"ckpt={tmp_path / 'first' / 'checkpoints'}")
    assert whole["global_step"] == second["global_step"] == 7 and whole["seconds"] == 7 * HOUR
    for part in ("state_dict", "current_model_state"):
        for name, value in whole[part].items():
            assert torch.equal(value, second[part][name]), name
    assert rate(whole) == rate(second) == pytest.approx(1e-3 * CosineSchedule(7.0).lr_ratio(6.0))
    one, two = curve(tmp_path / "whole"), curve(tmp_path / "second")
    assert [row[:3] for row in one] == [[0, 0, 0], [3, 3, 6], [6, 6, 12], [7, 7, 14]]
    assert [row[:3] for row in two] == [[0, 0, 0], [3, 3, 6], [4, 4, 8], [6, 6, 12], [7, 7, 14]]
    assert one[-1] == two[-1] and one[1] == two[1]


def test_more_hours_go_on_along_the_longer_cosine(tmp_path):
    first = run(tmp_path / "first", "train_hours=4")
    assert rate(first) == pytest.approx(1e-3 * CosineSchedule(4.0).lr_ratio(3.0))
    second = run(tmp_path / "second", "train_hours=8", f"ckpt={tmp_path / 'first' / 'checkpoints'}")
    assert second["global_step"] == 8
    assert rate(second) == pytest.approx(1e-3 * CosineSchedule(8.0).lr_ratio(7.0))
    same = run(tmp_path / "same", "train_hours=4", f"ckpt={tmp_path / 'second' / 'checkpoints'}")
    assert same["global_step"] == 8, "its hours are over"


def test_the_mean_is_exported_and_read_from_a_checkpoint(three_hours):
    shipped = files.load(three_hours / "now/net.safetensors")
    mean = files.load(three_hours / "checkpoints" / "last.ckpt")
    last = checkpoint(three_hours)
    head = last["state_dict"]["network.head.weight"]
    assert not torch.equal(head, last["current_model_state"]["network.head.weight"])
    assert torch.equal(mean.head.weight, head)
    assert torch.allclose(shipped.head.weight, head, atol=1e-3)


def test_exported_weights_go_on_where_no_checkpoint_is_left(three_hours, tmp_path):
    now = three_hours / "now/net.safetensors"
    first, before = checkpoint(three_hours), curve(three_hours)
    rise = ["callbacks.schedule.warmup_steps=4", "seed=1"]
    second = run(tmp_path / "second", "train_hours=6", f"ckpt={now}", *rise)
    assert second["seconds"] == 6 * HOUR and second["global_step"] == 3 and second["steps"] == 6
    assert second["windows"] == 2 * first["windows"]
    rows = curve(tmp_path / "second")
    assert files.read_card(now)["steps"] == 3 and len(files.read_card(now)["curve"]) == len(before)
    assert [row[:3] for row in rows] == [row[:3] for row in before] + [[6, 6, 12]]
    assert rows[: len(before)] == before
    assert rate(second) == pytest.approx(1e-3 * CosineSchedule(6.0).lr_ratio(5.0) * 3 / 5)


def test_weights_that_have_the_hours_already_are_refused(three_hours, tmp_path):
    now = three_hours / "now/net.safetensors"
    with pytest.raises(ValueError, match=r"train_hours must be > 3, the hours of ckpt=.*, got 3$"):
        run(tmp_path / "a", "train_hours=3", f"ckpt={now}")
    assert not (tmp_path / "a" / "results.json").exists()


def test_a_training_with_nothing_left_to_do_leaves_weights(three_hours, tmp_path):
    now, before = tmp_path / "net.safetensors", three_hours / "now/net.safetensors"
    same = ["train_hours=3", f"ckpt={three_hours / 'checkpoints'}"]
    run(tmp_path / "a", *same, f"export={now}")
    assert files.read_card(now) == files.read_card(before)
    assert torch.equal(files.load(now).head.weight, files.load(before).head.weight)


def test_nine_views_go_on_from_one_with_its_hours(tmp_path):
    now = tmp_path / "now.safetensors"
    run(tmp_path / "one", "train_hours=3", "experiment=single256", f"export={now}")
    nine = run(tmp_path / "nine", "train_hours=5", "experiment=lf3x3", f"ckpt={now}")
    assert nine["seconds"] == 5 * HOUR and nine["global_step"] == 2 and nine["steps"] == 5
    kernel = nine["state_dict"]["network.stem.weight"]
    assert kernel[:, 20:25].abs().mean() > 10 * kernel[:, :20].abs().mean() > 0


def test_a_training_that_is_cut_short_exports_what_it_has_reached(tmp_path, monkeypatch):
    now, step = tmp_path / "now.safetensors", Reconstructor.training_step

    def interrupted(self, sample, batch_idx):
        if self.global_step == 2:
            raise OSError("the disk is full")
        return step(self, sample, batch_idx)

    monkeypatch.setattr(Reconstructor, "training_step", interrupted)
    with pytest.raises(OSError, match="the disk is full"):
        run(tmp_path / "first", "train_hours=9", f"export={now}")
    card = files.read_card(now)
    assert (card["hours"], card["steps"], len(card["curve"])) == (2, 2, 1)


def test_a_training_cut_short_in_a_validation_exports_the_average(tmp_path, monkeypatch):
    now, validate = tmp_path / "now.safetensors", Reconstructor.validation_step

    def interrupted(self, sample, batch_idx):
        validate(self, sample, batch_idx)
        if self.global_step == 6:
            raise OSError("the disk is full")

    monkeypatch.setattr(Reconstructor, "validation_step", interrupted)
    with pytest.raises(OSError, match="the disk is full"):
        run(tmp_path / "x", "train_hours=9", f"export={now}", "trainer.limit_val_batches=1.0")
    stored = checkpoint(tmp_path / "x")["state_dict"]
    average = files.load(now).state_dict()
    module, _ = build.build_untrained_network(config("train", tmp_path, *TINY, *RECIPE))
    module.load_state_dict({k.removeprefix("network."): v for k, v in stored.items()})
    for name, value in inference_copy(module).state_dict().items():
        assert torch.allclose(value, average[name].float(), atol=1e-3), name


def test_a_training_that_has_collapsed_ends_and_keeps_what_it_had(tmp_path, monkeypatch):
    now = tmp_path / "now.safetensors"
    monkeypatch.setattr("src.training.learning_curve.COLLAPSE_FACTOR", 0.5)
    run(tmp_path / "few_steps", "train_hours=4", f"export={tmp_path / 'few.safetensors'}")
    monkeypatch.setattr("src.training.learning_curve.LEAST_STEPS", 1)
    with pytest.raises(ValueError, match="collapsed.* holds the weights of 0.00 hours"):
        run(tmp_path / "first", "train_hours=9", f"export={now}")
    assert files.read_card(now)["hours"] == 0


def test_losses_of_other_terms_are_not_compared(tmp_path):
    curve = LearningCurve(str(tmp_path / "c.csv"), 1.0)
    for weight, kept in ((1.0, 1), (1.0, 2), (3.0, 0)):
        curve.losses.append(1.0)
        curve._forget_other_loss(TrainingLoss({"l1": L1Term(weight)}))
        assert curve.losses == kept * [1.0]


def test_what_goes_on_with_another_loss_has_not_collapsed(three_hours, tmp_path):
    before, now = three_hours / "now/net.safetensors", tmp_path / "now.safetensors"
    card = files.read_card(before)
    card["curve"][-1]["loss"] = 1e-6
    files.save(now, files.load(before), files.read_network_spec(before), card)
    run(tmp_path / "second", "train_hours=6", f"ckpt={now}")
    assert len(curve(tmp_path / "second")) == len(card["curve"]) + 1


def test_restored_weights_are_those_that_were_exported(three_hours, tmp_path):
    now = three_hours / "now/net.safetensors"
    cfg = config("train", tmp_path / "second", *TINY, *RECIPE)
    network, _ = build.build_untrained_network(cfg)
    files.restore_weights(network, now)
    ours, theirs = inference_copy(network).state_dict(), files.load(now).state_dict()
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        wanted = theirs[name]
        if "gates.weight" in name:  # three steps have not found the largest singular value yet
            wanted = wanted / torch.linalg.matrix_norm(wanted.flatten(1), 2)
        assert torch.allclose(value, wanted, atol=2e-3), name


def test_weights_of_another_network_are_refused(tmp_path):
    now = tmp_path / "now.safetensors"
    network, spec = build.build_untrained_network(config("train", tmp_path, *TINY, *RECIPE))
    other, _ = build.build_untrained_network(config("train", tmp_path, *TINY, *RECIPE, "width=8"))
    files.save(now, network, spec, {})
    with pytest.raises(ValueError, match="ckpt does not fit E2VID"):
        files.restore_weights(other, now)


def test_a_training_whose_device_simulates_is_the_same(tmp_path):
    ways = [curve_of(tmp_path / where, where) for where in ("worker", "device")]
    assert ways[0] == ways[1]


def curve_of(folder: Path, where: str) -> list[list[float]]:
    run(folder, "train_hours=5", f"data.simulate_on={where}", "data.batch_reuse=2")
    return curve(folder)


def test_weights_without_a_curve_are_none_to_go_on_from(tmp_path):
    with pytest.raises(ValueError, match="ckpt must be of the network"):
        run(tmp_path / "a", "train_hours=3", "ckpt=weights/lf3x3.safetensors")


def test_the_average_forgets_the_start_and_then_moves_slowly():
    network = torch.nn.BatchNorm2d(2)
    averaged = AveragedModel(network, **WeightEMA(0.999)._kwargs)
    for value, steps in ((1.0, 1), (3.0, 1)):
        with torch.no_grad():
            network.weight.fill_(value)
        for _ in range(steps):
            averaged.update_parameters(network)
    assert torch.allclose(averaged.module.weight, torch.full((2,), 1 + 2 * 9 / 12))
    averaged.n_averaged.fill_(10**6)
    with torch.no_grad():
        network.weight.fill_(2.5)
        network.running_mean.fill_(5.0)
    averaged.update_parameters(network)
    assert torch.allclose(averaged.module.weight, torch.full((2,), 2.5))
    with torch.no_grad():
        network.weight.fill_(3.5)
    averaged.update_parameters(network)
    assert torch.allclose(averaged.module.weight, torch.full((2,), 2.501))
    assert torch.equal(averaged.module.running_mean, network.running_mean)


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["train_hours=0"], "train_hours must be > 0"),
        (["train_hours=1"], "scheduler must be null with train_hours=1"),
        (["train_clock=moon"], "train_clock must be one of wall, processor"),
        (["grad_clip_norm=0"], "grad_clip_norm must be > 0"),
        (["ema_decay=1"], "ema_decay must be in"),
        (["data.loss_from=2"], "data.loss_from must be in 0..1"),
        (["data.loss_pairs=2", "data.loss_from=0"], "data.loss_pairs must be in 1..1 or null"),
        (["callbacks.learning_curve.interval_h=0"], "callbacks.learning_curve.interval_h"),
        (["callbacks.schedule.warmup_steps=-1"], "callbacks.schedule.warmup_steps must be"),
        (["callbacks.schedule.warmup_steps=9"], "warmup_steps must be 0 without train_hours"),
        (["export=weights.pt"], "export must be a .safetensors"),
        (["export=w.safetensors"], "interval_h must be > 0 where export is given"),
        (["trainer.precision=16-mixed"], "trainer.precision must be bf16-mixed, 32-true or null"),
        (["stem=0"], "model.stem_channels must be >= 1"),
        (["state_rounding_step=2"], "model.state_rounding_step must be in"),
        (
            ["state_rounding_step=0.1", "model.recurrent=convgru"],
            "model.state_rounding_step must be in",
        ),
    ],
)
def test_a_wrong_value_names_its_key(overrides, key, tmp_path):
    with pytest.raises(ValueError, match=key):
        train(config("train", tmp_path, *TINY, *overrides))


def test_of_several_processes_the_clock_of_the_first_counts():
    strategy = SimpleNamespace(broadcast=lambda seconds: seconds - 2 * HOUR)
    trainer = Mock(spec=Trainer, world_size=2, strategy=strategy, should_stop=False)
    module = SimpleNamespace(clock=TrainingClock())
    module.clock.seconds = 4 * HOUR
    CosineSchedule(train_hours=3).on_train_batch_end(trainer, module)
    assert module.clock.hours == 2 and not trainer.should_stop
    module.clock.seconds = 6 * HOUR
    CosineSchedule(train_hours=3).on_train_batch_end(trainer, module)
    assert module.clock.hours == 4 and trainer.should_stop


def test_a_processor_clock_does_not_count_waiting():
    watch = TrainingClock("processor")
    watch.start()
    time.sleep(0.2)
    watch.lap()
    assert watch.seconds < 0.1 and watch.hours == watch.seconds / 3600


def test_a_training_stopped_in_its_last_test_names_its_checkpoint(tmp_path, monkeypatch, capsys):
    test_step = Reconstructor.test_step

    def interrupted(self, sample, batch_idx):
        if next(iter(tmp_path.rglob("last.ckpt")), None):
            raise OSError("the disk is full")
        test_step(self, sample, batch_idx)

    monkeypatch.setattr(Reconstructor, "test_step", interrupted)
    with pytest.raises(OSError, match="the disk is full"):
        run(tmp_path, "train_hours=2")
    said = capsys.readouterr().err
    assert f"stopped at step 2; go on with ckpt={tmp_path / 'checkpoints'}" in said
