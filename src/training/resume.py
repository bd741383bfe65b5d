"""A training that goes on from a checkpoint obeys its own config: rate, schedule and optimiser."""

import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer


def apply_config_to_optimizer_state(
    checkpoint: dict,
    parameters: Callable[[], Iterable[nn.Parameter]],
    make_optimizer: Callable[..., Optimizer],
    make_scheduler: Callable[..., Any] | None,
) -> bool:
    """Change the optimiser and scheduler that Lightning will restore from `checkpoint`; return
    whether the optimiser's state is kept.

    The numbers of the optimiser (rate, betas, weight decay) are those of the config.  Its state is
    kept where the config's optimiser has one of the same names; otherwise it begins anew, with a
    warning.  The schedule is the config's, at the step that the checkpoint has reached.
    """
    optimizer = make_optimizer(parameters())
    fresh = optimizer.state_dict()
    saved = checkpoint["optimizer_states"][0]
    kept = _fits(saved, fresh, make_optimizer)
    if kept:
        fresh["state"] = saved["state"]
    else:
        kind = type(optimizer).__name__
        message = f"ckpt holds the state of another optimiser than {kind}, which begins anew"
        warnings.warn(message, stacklevel=2)
    checkpoint["lr_schedulers"] = []
    if make_scheduler is not None:
        scheduler = _at_step(make_scheduler(optimizer), checkpoint["global_step"])
        checkpoint["lr_schedulers"] = [scheduler.state_dict()]
        fresh["param_groups"] = optimizer.state_dict()["param_groups"]
    checkpoint["optimizer_states"] = [fresh]
    return kept


def check_max_steps(max_steps: int, steps_done: int) -> None:
    """Raise ValueError where a training has taken more steps than it shall (-1: no limit)."""
    if 0 <= max_steps < steps_done:
        least = f"{steps_done}, the steps of ckpt"
        raise ValueError(f"trainer.max_steps must be >= {least}, got {max_steps}")


def _fits(saved: dict, fresh: dict, make_optimizer: Callable[..., Optimizer]) -> bool:
    """Return whether the state of every parameter has the names that the optimiser stores, which a
    step on a parameter of its own shows.
    """
    numbers = [group["params"] for group in saved["param_groups"]]
    if numbers != [group["params"] for group in fresh["param_groups"]]:
        return False
    parameter = nn.Parameter(torch.zeros(1))
    parameter.grad = torch.zeros(1)
    optimizer = make_optimizer([parameter])
    optimizer.step()
    return all(
        state.keys() == optimizer.state[parameter].keys() for state in saved["state"].values()
    )


def _at_step(scheduler: Any, steps: int) -> Any:
    """Return a fresh scheduler after `steps` steps of training."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its optimiser takes no steps
        for _ in range(steps):
            scheduler.step()
    return scheduler
