"""How fast a training is: python -m benchmarks.training [changes|networks] [key=value ...]

Overrides are those of src.train.  Without a word before, where a step's time goes: simulation
(shared by the `data.batch_reuse` steps that see a batch), the network's forward and backward pass,
and the loss with its gradient, on one batch; CPU time on one thread, wall time on two.
`changes`: whole steps of budget=hours on made-up grids, one thing changed at a time, by CPU time of
the one thread; `networks`: the same of several networks, before and after.  Clip-windows are
windows of single clips.
"""

import argparse
import time
from collections.abc import Callable
from itertools import pairwise

import lightning
import torch
from omegaconf import DictConfig
from torch.nn.utils import parametrize

from benchmarks.timing import least
from scripts.lease.probe import make_up_batch, train_on_batch
from src.app import build, hardware, simulation
from src.app.compose import compose_config
from src.app.script import run_script
from src.sim.pipeline import simulate

BEFORE = ["channels_last=false", "optimizer.fused=false", "ema_decay=null"]
CHANGES = {
    "as before": [],
    "channels-last": ["channels_last=true"],
    "fused Adam": ["optimizer.fused=true"],
    "moving average of the weights": ["ema_decay=0.999"],
    "float32": ["trainer.precision=32-true"],
    "batch 1": ["data.batch_size=1"],
    "batch 6": ["data.batch_size=6"],
    "crop 96, batch 2": ["data.crop=96", "data.batch_size=2"],
    "channels-last, fused, mean": ["channels_last=true", "optimizer.fused=true", "ema_decay=0.999"],
}
NETWORKS = {
    **{f"lf3x3, base {width}": ["experiment=lf3x3", f"width={width}"] for width in (8, 12, 16)},
    "lf3x3, base 8, stem 32": ["experiment=lf3x3", "width=8", "stem=32"],
    "lf3x3, base 16, stem 32": ["experiment=lf3x3", "width=16", "stem=32"],
    "single256, base 16, stem 32": ["experiment=single256", "width=16", "stem=32"],
}


def config(overrides: list[str]) -> DictConfig:
    """Return the config of src.train."""
    cfg = compose_config("train", *overrides)
    hardware.fill_in_precision(cfg)
    return cfg


def split(overrides: list[str]) -> tuple[dict[str, Callable[[], object]], int, int]:
    """Return the parts of a step as work to be timed, its clip-windows, and the steps that see a
    simulated batch.
    """
    cfg = config(overrides)
    network, spec = build.build_untrained_network(cfg)
    module = build.build_reconstructor(cfg, network, spec)
    pipeline = simulation.build_pipeline(cfg, "train")
    clips = list(range(cfg.data.batch_size))
    sample = simulate(pipeline, clips)
    half = torch.autocast("cpu", torch.bfloat16, enabled="bf16" in str(cfg.trainer.precision))

    def forward() -> torch.Tensor:
        with half, parametrize.cached():
            return network.reconstruct_clip(sample).flatten(0, 1).float()

    shown, truth = forward(), sample.target.flatten(0, 1)
    slope = torch.randn_like(shown)

    def loss() -> None:
        with half:
            module.loss(shown.detach().requires_grad_(), truth).sum().backward()

    parts = {
        "simulation": lambda: simulate(pipeline, clips),
        "forward": forward,
        "forward and backward": lambda: forward().backward(slope),
        "loss": loss,
    }
    return parts, len(truth), cfg.data.batch_reuse


class Steps(lightning.Callback):
    """Notes the CPU time at the end of every step."""

    def __init__(self):
        self.ends: list[float] = []

    def on_train_batch_end(self, *_) -> None:
        """Note the time."""
        self.ends.append(time.thread_time())


def step(overrides: list[str], steps: int = 3) -> tuple[float, int]:
    """Return the least seconds of a whole training step and the pixels of its clip-windows."""
    cfg = config(["budget=hours", "data.cache_clips=null", "train_hours=null", *overrides])
    batch, seen = make_up_batch(cfg), Steps()
    train_on_batch(cfg, batch, seen, steps + 1)
    return min(end - start for start, end in pairwise(seen.ends)), batch.target.numel()


def rate(overrides: list[str]) -> float:
    """Return clip-windows of 64x64 pixels a second."""
    seconds, pixels = step([*BEFORE, "stem=null", *overrides])
    return pixels / 64**2 / seconds


def changes(overrides: list[str]) -> None:
    """Print a Markdown table, a row for each of CHANGES."""
    print("| | clip-windows a second | faster by |\n|---|---|---|")
    for name, change in CHANGES.items():
        before = rate(overrides)  # anew for every row: the speed of a shared machine drifts
        now = rate([*change, *overrides]) if change else before
        print(f"| {name} | {now:.0f} | {now / before - 1:+.0%} |", flush=True)


def networks(overrides: list[str]) -> None:
    """Print a Markdown table, a row for each of NETWORKS: before, and with the last of CHANGES."""
    print("| | before | after |\n|---|---|---|")
    for name, network in NETWORKS.items():
        pair = [rate([*network, *change, *overrides]) for change in ([], [*CHANGES.values()][-1])]
        print(f"| {name} | {pair[0]:.0f} | {pair[1]:.0f} |", flush=True)


def main() -> None:
    """Print a table, or the split on one thread and on two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="changes or networks, then key=value")
    words, tables = parser.parse_args().words, {"changes": changes, "networks": networks}
    if words and words[0] in tables:
        torch.set_num_threads(1)
        tables[words[0]](words[1:])
        return
    parts, frames, reuse = split(words)
    for threads, clock in ((1, time.thread_time), (2, time.perf_counter)):
        torch.set_num_threads(threads)
        took = {name: least(work, clock, 4) for name, work in parts.items()}
        took["simulation"] /= reuse
        took["backward"] = took.pop("forward and backward") - took["forward"]
        whole = sum(took.values())
        shares = ", ".join(f"{name} {100 * t / whole:.0f} %" for name, t in took.items())
        print(f"{threads} thread(s): {frames / whole:.0f} clip-windows a second; {shares}")


if __name__ == "__main__":
    run_script(main)
