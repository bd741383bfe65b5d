"""The disk is full, a file cannot be read, a loader's worker dies, the cluster wants its node back:
the run says so, what was whole stays whole, and it goes on to the same numbers."""

import os
import resource
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from src.models.checkpoints import is_intact, newest_checkpoint, save_atomically
from src.recordings import output
from src.recordings.files.event_file import EVENT
from src.recordings.files.event_writers import write_events
from src.recordings.output import open_video_writer, partial_path
from src.recordings.reconstruction import Frame
from src.records import atomic
from tests.faults import harness
from tests.faults.harness import Run, Tally
from tests.faults.test_kills import STEPS, training

NOBODY = 65534


def written(path: Path, number: float) -> None:
    save_atomically({"state_dict": {"a": torch.full((50_000,), number)}}, path)


@contextmanager
def small_files(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond `size` bytes: writing on is an OSError."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_the_checkpoint_that_was_there(tmp_path):
    path = tmp_path / "last.ckpt"
    written(path, 1.0)
    with small_files(100_000), pytest.raises((OSError, RuntimeError)):
        written(path, 2.0)
    assert is_intact(path) and torch.load(path)["state_dict"]["a"][0] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_damaged_checkpoint_is_passed_over(tmp_path):
    for number, name in enumerate(("old", "new")):
        written(tmp_path / f"{name}.ckpt", number)
        os.utime(tmp_path / f"{name}.ckpt", (number, number))
    data = bytearray((tmp_path / "new.ckpt").read_bytes())
    data[len(data) // 2] ^= 1  # one bit of one weight
    (tmp_path / "new.ckpt").write_bytes(data)
    os.utime(tmp_path / "new.ckpt", (1, 1))
    with pytest.warns(UserWarning, match="new.ckpt is damaged"):
        assert newest_checkpoint(tmp_path).name == "old.ckpt"
    (tmp_path / "old.ckpt").unlink()
    with pytest.warns(UserWarning), pytest.raises(ValueError, match="ckpt must be a folder"):
        newest_checkpoint(tmp_path)


def test_a_folder_of_several_runs_says_which_one_is_taken(tmp_path):
    runs = tmp_path / "runs"
    last = [runs / name / "checkpoints" / "last.ckpt" for name in ("new", "old", "no_run")]
    for path, time in zip(last, (8, 7, 9), strict=True):
        path.parent.mkdir(parents=True)
        written(path, 1.0)
        os.utime(path, (time, time))
        if time < 9:  # of any other folder no checkpoint is taken
            (path.parents[1] / "config.yaml").touch()
    with pytest.warns(UserWarning, match="holds 2 runs, the newest is taken: .*new/checkpoints"):
        assert newest_checkpoint(runs) == last[0]
    with pytest.raises(ValueError, match="ckpt must be a folder with a whole checkpoint"):
        newest_checkpoint(tmp_path)


@pytest.mark.parametrize("kind", ["mp4", "png", "gif"])
def test_a_file_that_cannot_grow_is_no_whole_video(kind, tmp_path):
    pictures = np.random.default_rng(0).random((20, 96, 96), np.float32)
    with (
        small_files(4_000),
        pytest.raises((OSError, RuntimeError)),
        open_video_writer(kind, tmp_path, (96, 96)) as write,
    ):
        for number, picture in enumerate(pictures):
            write(Frame(0.01 * number, picture, 1, 0))
    assert not [file for file in tmp_path.iterdir() if "partial" not in file.name]
    assert partial_path(tmp_path / "frames.csv").is_file()


@pytest.mark.parametrize("kind", ["mp4", "png", "gif", "hdf5"])
def test_a_full_disk_is_no_whole_video(kind, tmp_path, monkeypatch):
    usage = output.shutil.disk_usage(tmp_path)
    picture = np.zeros((96, 96), np.float32)
    with (
        pytest.raises(OSError, match="No space left"),
        open_video_writer(kind, tmp_path, (96, 96)) as write,
    ):
        write(Frame(0.0, picture, 1, 0))
        monkeypatch.setattr(output.shutil, "disk_usage", lambda path: usage._replace(free=1 << 20))
        write(Frame(0.1, picture, 1, 0))
    assert not [file for file in tmp_path.iterdir() if "partial" not in file.name]


@pytest.mark.parametrize("name", ["a.raw", "a.dat", "a.aedat4", "a.es", "a.csv", "a.npz"])
def test_a_full_disk_is_no_recording_and_names_it(name, tmp_path):
    events = np.zeros(200_000, EVENT)
    events["t"] = np.arange(0, 3 * len(events), 3)
    events["x"], events["p"] = np.arange(len(events)) % 97, 1
    with small_files(40_000), pytest.raises(OSError, match=f"File too large.*{name}"):
        write_events(tmp_path / name, events, width=97, height=5)
    assert not list(tmp_path.iterdir())


def test_hdf5_stops_before_the_disk_is_full(tmp_path, monkeypatch):
    usage = atomic.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(atomic.shutil, "disk_usage", lambda path: usage._replace(free=1 << 20))
    with pytest.raises(OSError, match="No space left"):
        write_events(tmp_path / "a.h5", np.ones(9, EVENT), width=97, height=5)
    assert not list(tmp_path.iterdir())


READERS = {
    "cap.txt": "src.recordings.files.recording.read_events",
    "cap.h5": "src.recordings.files.recording.read_events",
    "views.yaml": "src.recordings.views.load_views",
    "photo.png": "src.sim.scenes.photo_files.decode_photograph",
    "net.ckpt": "src.models.files.load",
    "net.safetensors": "src.models.files.load",
    "old.pth": "baselines.pickled_weights.read_pickled_tensors",
}


def read_as_nobody(path: str, reader: str) -> None:
    from hydra.utils import get_object

    function = get_object(reader)
    os.setgid(NOBODY)
    os.setuid(NOBODY)
    function(Path(path))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody who may not read")
def test_a_file_that_may_not_be_read_is_named(tmp_path):
    tally, folder = Tally("unreadable files"), Path(tempfile.mkdtemp())
    folder.chmod(0o755)  # pytest's own folders are closed to others
    for name, reader in READERS.items():
        path = folder / name
        path.write_bytes(b"0.1 1 2 1\n")
        path.chmod(0)
        with tally.run():
            tally.injected += 1
            run = Run(tmp_path / "log", read_as_nobody, str(path), reader)
            assert run.wait() in (1, 2), run.text()
            assert (
                "Traceback" not in run.text() and "error: " in run.text() and name in run.text()
            ), run.text()


def train_and_lose_a_worker(config: str) -> None:
    """Run src.train; the loader's worker that simulates clip 2 dies as if out of memory."""
    from src.sim.pipeline import Pipeline

    draw, main = Pipeline.draw, os.getpid()

    def die(self, number: int):
        if self.split == "train" and number == 2 and os.getpid() != main:
            os.kill(os.getpid(), signal.SIGKILL)
        return draw(self, number)

    Pipeline.draw = die
    harness.run_entry_point("train", config)


def test_a_worker_that_dies_ends_the_run_and_it_goes_on(tmp_path, alone):
    numbers, _ = alone  # computed without a worker
    tally = Tally("a loader's worker dies")
    with tally.run():
        tally.injected += 1
        first = training(tmp_path / "first", "data.workers=1")
        run = Run(tmp_path / "log", train_and_lose_a_worker, first)
        assert run.wait() == 1 and "DataLoader worker" in run.text(), run.text()
        assert f"go on with ckpt={tmp_path / 'first' / 'checkpoints'}" in run.text()
        rest = training(tmp_path / "rest", "data.workers=1", f"ckpt={tmp_path / 'first'}")
        run = Run(tmp_path / "rest.log", harness.run_entry_point, "train", rest)
        assert run.wait() == 0, run.text()
        assert harness.outcome(tmp_path / "rest") == numbers


def on_slurm(config: str, folder: str) -> None:
    """Run src.train as SLURM starts it, with an `scontrol` that writes down its orders."""
    os.environ |= {
        "SLURM_JOB_ID": "77", "SLURM_NTASKS": "1", "SLURM_NTASKS_PER_NODE": "1",
        "SLURM_JOB_NAME": "train", "SLURM_PROCID": "0", "SLURM_LOCALID": "0", "SLURM_NODEID": "0",
        "SLURM_JOB_NUM_NODES": "1", "PATH": f"{folder}:{os.environ['PATH']}",
    }  # fmt: skip
    harness.run_entry_point("train", config)


def test_a_preempted_job_is_requeued_and_goes_on(tmp_path, alone):
    numbers, _ = alone
    order = tmp_path / "scontrol"
    order.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/orders\n')
    order.chmod(0o755)
    tally = Tally("preempted on SLURM")
    with tally.run():
        config = training(tmp_path / "run", "trainer=slurm")
        run = Run(tmp_path / "log", on_slurm, config, str(tmp_path))
        assert run.wait_until(lambda: bool(list((tmp_path / "run").rglob("every*.ckpt"))))
        os.kill(run.process.pid, signal.SIGUSR1)
        assert run.wait_until(lambda: (tmp_path / "orders").is_file()), run.text()
        assert run.stop(signal.SIGTERM) in (0, 143, -15), run.text()
        tally.injected += 1
        assert (tmp_path / "orders").read_text() == "requeue 77\n"
        (kept,) = (tmp_path / "run").glob("hpc_ckpt_*.ckpt")
        assert 0 < torch.load(kept, weights_only=True)["global_step"] <= STEPS and is_intact(kept)
        again = Run(tmp_path / "log2", on_slurm, config, str(tmp_path))
        assert again.wait() == 0, again.text()
        assert harness.outcome(tmp_path / "run") == numbers


def may_mount() -> bool:
    return os.geteuid() == 0 and subprocess.run(["unshare", "-m", "true"]).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not may_mount(), reason="mounting a small disk is not permitted here")
def test_a_disk_that_is_full_in_earnest(tmp_path, alone):
    numbers, _ = alone
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=210m", "tmpfs", str(disk)], check=True)
    tally = Tally("disk full (tmpfs)")
    try:
        with tally.run():
            run = Run(tmp_path / "log", harness.run_entry_point, "train", training(disk / "first"))
            assert run.wait_until(lambda: bool(list(disk.rglob("every*.ckpt"))))
            with pytest.raises(OSError, match="No space"), (disk / "ballast").open("wb") as ballast:
                while True:
                    ballast.write(bytes(1 << 20))
                    ballast.flush()
            tally.injected += 1
            assert run.wait() != 0 and "No space left" in run.text(), run.text()
            assert "go on with ckpt=" in run.text()
            (disk / "ballast").unlink()
            assert not list(disk.rglob("*.partial"))
            rest = training(disk / "rest", f"ckpt={disk / 'first'}")
            assert Run(tmp_path / "log2", harness.run_entry_point, "train", rest).wait() == 0
            assert harness.outcome(disk / "rest") == numbers
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_too_little_room_is_said_before_anything_is_done(tmp_path, monkeypatch):
    from src.records import results

    usage = results.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(results.shutil, "disk_usage", lambda path: usage._replace(free=1 << 20))
    with pytest.raises(ValueError, match="paths.out must have 200 MiB free, got 1 MiB"):
        results.create_run_folder(tmp_path / "run", OmegaConf.to_yaml({"a": 1}))
    assert not (tmp_path / "run" / "config.yaml").exists()
