"""What a user meets at an entry point: one line and exit code 2, a checkpoint after Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tests.conftest import ROOT

TINY = ["debug=fdr", "loss=l1", "metrics.lpips=null", "logger=none"]


def command(entry_point: str, *overrides: str) -> list[str]:
    return [sys.executable, "-m", f"src.{entry_point}", *overrides]


def environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1"}


@pytest.mark.parametrize(
    ("entry_point", "overrides", "said"),
    [
        ("train", ["experiment=lf9x9"], "lf9x9"),
        ("train", [*TINY, "data.crop=1000"], "data.crop must be in 8..64"),
        ("eval", [], "ckpt or baseline must name a network"),
        ("eval", ["ckpt=nowhere"], "ckpt must be a file or one of weights/"),
    ],
)
def test_a_wrong_value_is_one_line_and_exit_code_2(entry_point, overrides, said, tmp_path):
    done = subprocess.run(
        command(entry_point, *overrides, f"paths.out={tmp_path}"),
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert said in line and "Traceback" not in done.stderr
    assert not list(tmp_path.rglob("results.json"))


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_leaves_a_checkpoint_that_loads(stop, tmp_path):
    many = ["trainer.max_steps=100000", "data.epoch_clips=100000"]
    many += ["callbacks.rotation.every_n_train_steps=2"]
    run = subprocess.Popen(
        command("train", *TINY, *many, f"paths.out={tmp_path}"),
        cwd=ROOT,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_for(lambda: any(tmp_path.rglob("every*.ckpt")), run)
        run.send_signal(stop)
        run.wait(timeout=60)
    finally:  # or it trains on when a test has failed
        run.kill()
        run.wait()
    assert run.returncode != 0
    (last,) = tmp_path.rglob("last.ckpt")
    content = torch.load(last, weights_only=True)
    assert content["global_step"] > 0 and content["network"]["target"].endswith("E2VID")


def wait_for(happened, run: subprocess.Popen, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not happened():
        assert run.poll() is None and time.monotonic() < end
        time.sleep(0.1)


def test_a_checkpoint_of_another_network_is_refused(tmp_path):
    from src.models import files

    path = Path(tmp_path) / "other.ckpt"
    spec = {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 1}}
    torch.save({"network": spec, "state_dict": {}}, path)
    with pytest.raises(ValueError, match="ckpt must be of the network"):
        files.find_checkpoint(
            str(path), {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 9}}
        )
    path.write_bytes(b"no checkpoint")
    with pytest.raises(ValueError, match="ckpt must be a checkpoint"):
        files.find_checkpoint(str(path), spec)
