"""How many operators a training step launches: python -m benchmarks.operators [key=value ...]

A batch out of a cache in memory, simulated, augmented and trained on, clip by clip and batched, on
a CPU at small crops: what is counted does not depend on the size.  On a GPU each operator is a
launch or more, each of 5 to 10 us, whatever its size.  Views and allocations are not counted; on a
GPU the sensor is one launch more for each call, which here is no operator of torch.
"""

import argparse

import lightning
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.training import config
from scripts.lease.probe import train_on_batch
from src.app import build
from src.app.script import run_script
from src.sim import noise

SMALL = [
    "budget=hours", "data.cache_clips=2", "data.cache_device=device", "data.cache_crop=48",
    "data.crop=32", "data.windows=40", "data.batch_size=16", "data.loss_pairs=4", "scene.height=64",
    "scene.width=64", "turbulence=weak", "train_hours=null",
    "augment.max_firing_pixel_fraction=0.001",
]  # fmt: skip


class OperatorCounter(TorchDispatchMode):
    """Counts the operators that compute something."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Run an operator; count it unless it is a view or an allocation."""
        idle = func.is_view or func._overloadpacket._qualified_op_name.startswith("aten::empty")
        self.count += not idle
        return func(*args, **(kwargs or {}))


class StepCounter(lightning.Callback):
    """Counts the operators of the second step."""

    def on_train_batch_start(self, trainer, module, batch, batch_idx: int) -> None:
        """Begin with the second step."""
        self.mode = OperatorCounter() if batch_idx == 1 else None
        if self.mode:
            self.mode.__enter__()

    def on_train_batch_end(self, *_) -> None:
        """End with the step."""
        if self.mode:
            self.mode.__exit__(None, None, None)
            self.operators = self.mode.count


def count_simulation(cfg, batched: bool) -> tuple[int, int, object]:
    """Return the operators of the simulation and of the augmentation of a batch, and the batch."""
    data = build.build_data_module(cfg, ("train",))
    pipeline, numbers = data.pipelines["train"], range(cfg.data.batch_size)
    for index in pipeline.cache.missing():
        pipeline.cache.clip(index)
    keys = [noise.key(number) for number in numbers]
    with OperatorCounter() as simulated:
        draws = [pipeline.draw(number) for number in numbers]
        samples = (
            [pipeline.simulate(draws, batched=True)]
            if batched
            else [pipeline.simulate([draw]) for draw in draws]
        )
    with OperatorCounter() as augmented:
        batch = data.augment(samples, keys, batched=batched)
    return simulated.count, augmented.count, batch


def count_step(cfg, batch) -> int:
    """Return the operators of a step on a batch."""
    count = StepCounter()
    train_on_batch(cfg, batch, count, 2)
    return count.operators


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("overrides", nargs="*", help="key=value of src.train")
    cfg = config([*SMALL, *parser.parse_args().overrides])
    apart, together = (count_simulation(cfg, batched) for batched in (False, True))
    step = count_step(cfg, together[2])
    print(f"{cfg.name}, {cfg.data.batch_size} clips of {cfg.data.windows} windows\n")
    print("| operators of | clip by clip | batched |\n|---|---|---|")
    print(f"| draw, gather, sensor | {apart[0]} | {together[0]} |")
    print(f"| augmentation | {apart[1]} | {together[1]} |")
    print(f"| step | {step} | {step} |")


if __name__ == "__main__":
    run_script(main)
