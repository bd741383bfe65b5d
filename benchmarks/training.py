"""Where a training step's time goes: python -m benchmarks.training [key=value ...]

Overrides are those of src.train.  Simulation (shared by the `data.reuse` steps that see a batch),
the network's forward and backward pass, and the loss with its gradient, on one batch: CPU time of
the thread on one thread, wall time on two.  Clip-frames are windows of single clips.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from torch.nn.utils import parametrize

from benchmarks.timing import least
from src.app import build
from src.models.unroll import video
from src.sim.pipeline import simulate

ROOT = Path(__file__).resolve().parents[1]


def split(overrides: list[str]) -> tuple[dict[str, Callable[[], object]], int, int]:
    """Return the parts of a step as work to be timed, its clip-frames, and the steps that see a
    simulated batch.
    """
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        cfg = compose("train", overrides)
    network, spec = build.network(cfg)
    module, pipeline = build.reconstructor(cfg, network, spec), build.pipeline(cfg, "train")
    clips = list(range(cfg.data.batch_size))
    sample = simulate(pipeline, clips)
    half = torch.autocast("cpu", torch.bfloat16, enabled="bf16" in str(cfg.trainer.precision))

    def forward() -> torch.Tensor:
        with half, parametrize.cached():
            return video(network, sample).flatten(0, 1).float()

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
    return parts, len(truth), cfg.data.reuse


def main() -> None:
    """Print the split on one thread and on two."""
    parts, frames, reuse = split(sys.argv[1:])
    for threads, clock in ((1, time.thread_time), (2, time.perf_counter)):
        torch.set_num_threads(threads)
        took = {name: least(work, clock, 4) for name, work in parts.items()}
        took["simulation"] /= reuse
        took["backward"] = took.pop("forward and backward") - took["forward"]
        whole = sum(took.values())
        shares = ", ".join(f"{name} {100 * t / whole:.0f} %" for name, t in took.items())
        print(f"{threads} thread(s): {frames / whole:.0f} clip-frames a second; {shares}")


if __name__ == "__main__":
    main()
