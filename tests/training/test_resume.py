"""A training that goes on: rate, schedule and optimiser are the config's; fitting state is kept."""

import math
from functools import partial

import pytest
import torch
from torch import nn
from torch.optim import SGD, Adam, AdamW
from torch.optim.lr_scheduler import CosineAnnealingLR

from src.train import train
from src.training.resume import apply_config_to_optimizer_state, check_max_steps
from tests.test_train import TINY, UNDRAWN, config

STEPS = 4
RECIPE = [*TINY, *UNDRAWN, "experiment=single256"]


def network() -> nn.Linear:
    return nn.Linear(2, 1)


def checkpoint(make_optimizer, t_max: int = 4) -> dict:
    """The part of a checkpoint that an optimiser and its schedule leave after STEPS steps."""
    net = network()
    optimizer = make_optimizer(net.parameters())
    scheduler = CosineAnnealingLR(optimizer, t_max)
    for _ in range(STEPS):
        net(torch.ones(1, 2)).sum().backward()
        optimizer.step()
        scheduler.step()
    states = {"optimizer_states": [optimizer.state_dict()]}
    return states | {"lr_schedulers": [scheduler.state_dict()], "global_step": STEPS}


def cosine(rate: float, step: int, t_max: int) -> float:
    return rate * (1 + math.cos(math.pi * step / t_max)) / 2


@pytest.mark.parametrize("change", [{}, {"weight_decay": 0.01}, {"betas": (0.8, 0.9)}])
def test_numbers_and_schedule_are_the_configs_and_moments_stay(change):
    saved = checkpoint(partial(Adam, lr=1e-3))
    moments = saved["optimizer_states"][0]["state"][0]["exp_avg"].clone()
    kept = apply_config_to_optimizer_state(
        saved,
        network().parameters,
        partial(Adam, lr=0.1, **change),
        partial(CosineAnnealingLR, T_max=8),
    )
    (group,) = saved["optimizer_states"][0]["param_groups"]
    assert (
        kept and group["lr"] == pytest.approx(cosine(0.1, STEPS, 8)) and group["initial_lr"] == 0.1
    )
    assert {name: group[name] for name in change} == change
    assert torch.equal(saved["optimizer_states"][0]["state"][0]["exp_avg"], moments)
    (schedule,) = saved["lr_schedulers"]
    assert (schedule["T_max"], schedule["last_epoch"]) == (8, STEPS)


@pytest.mark.parametrize(
    ("other", "kept"),
    [
        (partial(SGD, lr=0.1), False),
        (partial(SGD, lr=0.1, momentum=0.9), False),
        (partial(Adam, lr=0.1, amsgrad=True), False),
        (partial(AdamW, lr=0.1), True),
    ],
)
def test_the_state_of_another_optimiser_is_dropped_and_said(other, kept):
    saved = checkpoint(partial(Adam, lr=1e-3))
    net = network()
    if kept:
        assert apply_config_to_optimizer_state(saved, net.parameters, other, None)
    else:
        with pytest.warns(UserWarning, match="ckpt holds the state of another optimiser"):
            assert not apply_config_to_optimizer_state(saved, net.parameters, other, None)
    optimizer = other(net.parameters())
    optimizer.load_state_dict(saved["optimizer_states"][0])
    assert bool(optimizer.state) == kept and saved["lr_schedulers"] == []
    net(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    assert optimizer.param_groups[0]["lr"] == 0.1


def rates(folder) -> tuple[float, list[int]]:
    found = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    schedules = [schedule["T_max"] for schedule in found["lr_schedulers"]]
    return found["optimizer_states"][0]["param_groups"][0]["lr"], schedules


HOURS = ["scheduler=null", "train_hours=1000"]
GOING_ON = [
    ("steps", ["scheduler.T_max=8"], cosine(0.1, 3, 8), [8]),
    ("hours", HOURS, 0.1, []),
    ("steps", HOURS, 0.1, []),
]


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """The folder of two trainings of two steps, with a scheduler and by time."""
    folder = tmp_path_factory.mktemp("begun")
    for name, words in (("steps", []), ("hours", HOURS)):
        train(config("train", folder / name, *RECIPE, *words, "trainer.max_steps=2"))
    return folder


@pytest.mark.parametrize(("before", "after", "rate", "schedules"), GOING_ON)
def test_a_run_that_goes_on_obeys_its_config(before, after, rate, schedules, begun, tmp_path):
    more = [*after, "optimizer.lr=0.1", "trainer.max_steps=3", f"ckpt={begun / before}"]
    train(config("train", tmp_path, *RECIPE, *more))
    found = rates(tmp_path)
    assert found[0] == pytest.approx(rate, rel=1e-4) and found[1] == schedules


def test_without_averaging_a_run_goes_on_from_the_weights_in_training(tmp_path):
    steps = ["trainer.max_steps=2", "optimizer.lr=0.01"]
    train(config("train", tmp_path / "a", *RECIPE, *steps, "ema_decay=0.9"))
    plain = ["ema_decay=null", f"ckpt={tmp_path / 'a'}"]
    train(config("train", tmp_path / "b", *RECIPE, *steps, *plain))
    before, after = (
        torch.load(tmp_path / run / "checkpoints" / "last.ckpt", weights_only=True) for run in "ab"
    )
    for name, value in before["current_model_state"].items():
        assert torch.equal(after["state_dict"][name], value), name
    assert any(not torch.equal(after["state_dict"][n], v) for n, v in before["state_dict"].items())


def test_fewer_steps_than_were_taken_are_refused():
    for allowed in (-1, STEPS, STEPS + 1):
        check_max_steps(allowed, STEPS)
    with pytest.raises(
        ValueError, match="trainer.max_steps must be >= 4, the steps of ckpt, got 2"
    ):
        check_max_steps(2, STEPS)
