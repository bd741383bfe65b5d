"""A run has its folder for itself."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest
from omegaconf import OmegaConf

from src.records.run_lock import hold_run_folder
from tests.conftest import ROOT
from tests.test_entry_points import run_here

HOLDING = """
import os, sys, time
from pathlib import Path
from src.records.run_lock import hold_run_folder

with hold_run_folder(Path(sys.argv[1])):
    child = os.fork()  # a worker that outlives the process
    if child == 0:
        time.sleep(60)
    print(child, flush=True)
    time.sleep(60)
"""


@contextmanager
def holding(folder):
    command = [sys.executable, "-c", HOLDING, str(folder)]
    other = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    child = int(other.stdout.readline())
    try:
        yield other
    finally:
        other.kill()
        os.kill(child, signal.SIGKILL)
        other.wait()
        other.stdout.close()


def test_a_folder_that_another_process_writes_into_is_refused_until_it_ends(tmp_path, capsys):
    with holding(tmp_path) as other:
        assert run_here("eval", "baseline=highpass", f"hydra.run.dir={tmp_path}") == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: hydra.run.dir, or paths.out of a sweep, must be another")
        assert str(tmp_path) in line and not (tmp_path / "config.yaml").exists()
        other.kill()
        other.wait()
        with hold_run_folder(tmp_path):
            pass


def test_processes_that_train_together_share_a_folder(tmp_path, monkeypatch):
    with holding(tmp_path):
        with pytest.raises(ValueError, match="another process writes into"), \
                hold_run_folder(tmp_path):  # fmt: skip
            pass
        monkeypatch.setenv("LOCAL_RANK", "1")
        with hold_run_folder(tmp_path):
            pass


def test_runs_of_one_second_have_a_folder_each():
    folder = OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / "hydra" / "default.yaml"))
    assert folder["run"]["dir"].endswith("-%f}")
