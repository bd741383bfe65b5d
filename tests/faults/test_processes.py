"""Two processes that train together do what one does with the joint batch."""

import csv
import os
import socket
from pathlib import Path

import pytest
import torch

from src.training.datamodule import StepSampler
from tests.faults import harness
from tests.faults.harness import Run
from tests.faults.test_kills import training


def test_no_clip_is_made_by_two_processes_and_none_is_left_out():
    def clips(size: int, rank: int, world: int) -> list[list[int]]:
        sampler = StepSampler(
            batch_size=size,
            steps_per_epoch=6,
            current_step=lambda: 0,
            batch_reuse=1,
            rank=rank,
            world=world,
        )
        return [[item.clip for item in batch] for batch in sampler]

    joint = clips(6, 0, 1)
    for world in (2, 3):
        shares = [clips(6 // world, rank, world) for rank in range(world)]
        for step, batch in enumerate(joint):
            assert sorted(clip for share in shares for clip in share[step]) == batch


def as_rank(rank: int, port: int, config: str) -> None:
    """Run src.train as the process `rank` of two."""
    from lightning.pytorch.utilities import rank_zero_only

    rank_zero_only.rank = rank
    os.environ |= {"LOCAL_RANK": str(rank), "NODE_RANK": "0", "WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo"}
    harness.run_entry_point("train", config)


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def losses(run: Path) -> list[float]:
    with (run / "logs" / "metrics.csv").open() as file:
        found = [row["train/loss"] for row in csv.DictReader(file)]
    return [float(loss) for loss in found if loss]


def test_two_processes_train_as_one_with_the_joint_batch(tmp_path):
    few = ["trainer.max_steps=3", "data.epoch_clips=4", "data.batch_reuse=1", "logger=csv"]
    # Adam's first steps have the size of the rate whatever the gradient: rounding would show.
    few += ["optimizer._target_=torch.optim.SGD", "optimizer.lr=0.1", "trainer.precision=32-true"]
    two = training(tmp_path / "two", *few, "trainer=ddp", "data.batch_size=1")
    one = training(tmp_path / "one", *few, "data.batch_size=2")
    port = free_port()
    runs = [Run(tmp_path / f"log{rank}", as_rank, rank, port, two) for rank in (0, 1)]
    runs.append(Run(tmp_path / "log", harness.run_entry_point, "train", one))
    for run in runs:
        assert run.wait() == 0, run.text()
    assert losses(tmp_path / "two") == pytest.approx(losses(tmp_path / "one"), rel=1e-5)
    first, second = weights(tmp_path / "two"), weights(tmp_path / "one")
    for name, value in first.items():
        assert torch.allclose(value, second[name], rtol=1e-4, atol=1e-6), name
    assert (tmp_path / "two" / "results.json").is_file()


@pytest.mark.slow
def test_two_processes_that_train_by_time_stop_together(tmp_path):
    by_time = ["train_hours=0.001", "scheduler=null", "trainer.max_steps=-1", "data.batch_size=1"]
    two = training(tmp_path / "two", *by_time, "data.batch_reuse=1", "trainer=ddp")
    port = free_port()
    runs = [Run(tmp_path / f"log{rank}", as_rank, rank, port, two) for rank in (0, 1)]
    for run in runs:
        assert run.wait() == 0, run.text()
    assert (tmp_path / "two" / "results.json").is_file()
