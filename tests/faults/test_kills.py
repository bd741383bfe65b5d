"""Killed, terminated or interrupted anywhere, a run goes on to the numbers of one left alone."""

import json
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from src.models import files
from src.models.checkpoints import newest, whole
from src.models.e2vid import E2VID
from src.recordings.files.formats import EVENT, write_events
from src.records import results
from src.records.results import Row
from tests.faults import harness
from tests.faults.harness import Run, Tally
from tests.test_train import TINY, config

STOPS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
STEPS = 12
STEADY = [
    *TINY,
    "logger=none",
    f"trainer.max_steps={STEPS}",
    "data.epoch_clips=4",
    "callbacks.rotation.every_n_train_steps=3",
    "augment.noise_std=0.1",
    "turbulence=none",
    "optics=single",
]


def training(run: Path, *more: str) -> str:
    return OmegaConf.to_yaml(config("train", run, *STEADY, *more), resolve=True)


def evaluation(run: Path, *more: str) -> str:
    small = ["scene.height=64", "scene.width=64", "data.test_clips=2", "data.test_windows=3"]
    small += ["data.warmup=1", "data.workers=0", "metrics.lpips=null", "baseline=highpass"]
    small += ["turbulence=none"]
    return OmegaConf.to_yaml(config("eval", run, *small, *more), resolve=True)


@pytest.fixture(scope="session")
def recording(tmp_path_factory) -> Path:
    """A small recording and a network that reconstructs it, in one folder."""
    folder = tmp_path_factory.mktemp("recording")
    g = np.random.default_rng(0)
    events = np.zeros(60_000, EVENT)
    events["t"] = np.sort(g.integers(0, 1_000_000, len(events)))
    events["x"], events["y"] = g.integers(0, 32, (2, len(events)))
    events["p"] = g.choice([-1, 1], len(events))
    write_events(folder / "cap.raw", events, width=32, height=32)
    spec = {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 1, "base_channels": 4}}
    torch.manual_seed(0)
    files.save(folder / "net.safetensors", E2VID(**spec["kwargs"]), spec, {})
    return folder


def reconstruction(run: Path, recording: Path, *more: str) -> str:
    given = [f"recording={recording / 'cap.raw'}", f"ckpt={recording / 'net.safetensors'}"]
    return OmegaConf.to_yaml(config("reconstruct", run, *given, "output=png", *more), resolve=True)


def stopped(run: Run, stop: int, after: float) -> bool:
    """Stop a run after so many seconds; return whether it was still there."""
    end = time.monotonic() + after
    run.until(lambda: time.monotonic() > end)
    code = run.stop(stop)
    assert code in (0, -stop, 128 + stop), run.text()
    return code != 0


def disturbed(folder: Path, stops: list[int], draw: random.Random, seconds: float, tally: Tally):
    """Stop a training again and again, each time going on from the newest checkpoint there is."""
    left: list[str] = []
    for number, stop in enumerate(stops):
        run = Run(folder / f"log{number}", harness.train, training(folder / f"run{number}", *left))
        if not stopped(run, stop, draw.uniform(0.1, 0.7 * seconds)):
            return harness.outcome(folder / f"run{number}")
        tally.injected += 1
        here, found = f"run{number}/checkpoints", list(folder.rglob("*.ckpt"))
        if "stopped at step" in run.text():
            assert f"go on with ckpt={folder / here}" in run.text()
        assert all(whole(path) for path in found)
        left = [f"ckpt={newest(folder)}"] if found else []
    run = Run(folder / "log", harness.train, training(folder / "last", *left))
    assert run.wait() == 0, run.text()
    return harness.outcome(folder / "last")


def again(folder: Path, work, given, stops: list[int], draw: random.Random, tally: Tally) -> list:
    """Stop `work` at random moments, repeat it whole; return the folders: whole, alone, stopped.

    `given(run)` is the config of a run in the folder `run`.
    """
    start = time.monotonic()
    assert Run(folder / "log", work, given(folder / "alone")).wait() == 0
    seconds = time.monotonic() - start
    for number, stop in enumerate(stops):
        run = Run(folder / f"log{number}", work, given(folder / "stopped"))
        tally.injected += stopped(run, stop, draw.uniform(0.1, seconds))
    final = Run(folder / "final", work, given(folder / "stopped"))
    assert final.wait() == 0, final.text()
    return [folder / "alone", folder / "stopped"]


def disturb_training(folder: Path, alone, seed: int, stops: list[int]) -> None:
    numbers, seconds = alone
    tally, draw = Tally(f"training, seed {seed}"), random.Random(seed)
    with tally.run():
        while not tally.injected:  # on a machine that got faster it may end before it is stopped
            assert disturbed(folder / f"{seconds:.3f}", stops, draw, seconds, tally) == numbers
            seconds /= 2


def disturb_evaluation(folder: Path, seed: int, stops: list[int]) -> None:
    tally = Tally(f"evaluation, seed {seed}")
    with tally.run():
        runs = again(folder, harness.evaluate, evaluation, stops, random.Random(seed), tally)
        first, second = map(harness.outcome, runs)
        assert first == second


def disturb_reconstruction(folder: Path, recording: Path, seed: int, stops: list[int]) -> None:
    tally = Tally(f"reconstruction, seed {seed}")
    with tally.run():
        runs = again(
            folder,
            harness.reconstruct,
            lambda run: reconstruction(run, recording),
            stops,
            random.Random(seed),
            tally,
        )
        first, second = (
            {file.name: file.read_bytes() for file in sorted((run / "frames").glob("*.png"))}
            | {"frames.csv": (run / "frames.csv").read_bytes()}
            for run in runs
        )
        assert first == second and len(first) > 100


def write_results_for_ever(run: str) -> None:
    clips = [{"name": f"clip{n}", "psnr": 20.0 + n, "ssim": 0.5} for n in range(300)]
    row = Row("net", clips, params=1, macs_per_frame=1, latency_ms={"64x64": 1.0})
    for seed in range(10**9):
        results.write(Path(run), "a: 1", [row], task="train", experiment="x", seed=seed)


def disturb_writing(folder: Path, seed: int, times: int) -> None:
    draw, tally, run = random.Random(seed), Tally("results.json"), folder / "run"
    run.mkdir()
    with tally.run():
        for _ in range(times):
            work = Run(folder / "log", write_results_for_ever, str(run))
            work.until(lambda work=work: "300 test clips" in work.text())
            stopped(work, draw.choice(STOPS), draw.uniform(0, 0.1))
            tally.injected += 1
            record = json.loads((run / "results.json").read_text())
            assert record["test"]["clips"] == 300
            assert len((run / "clips.csv").read_text().splitlines()) == 301


def test_training_goes_on_to_the_same_numbers(tmp_path, alone):
    disturb_training(tmp_path, alone, 0, [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])


@pytest.mark.slow
def test_evaluation_repeats_its_numbers(tmp_path):
    disturb_evaluation(tmp_path, 0, [signal.SIGTERM])


def test_reconstruction_repeats_its_frames(tmp_path, recording):
    disturb_reconstruction(tmp_path, recording, 0, [signal.SIGINT])


def test_results_are_whole_whenever_the_writer_dies(tmp_path):
    disturb_writing(tmp_path, 0, 3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_stopped_anywhere_many_times(tmp_path, alone, recording, seed):
    draw = random.Random(seed)
    disturb_training(tmp_path / "train", alone, seed, [draw.choice(STOPS) for _ in range(6)])
    disturb_evaluation(tmp_path / "eval", seed, [draw.choice(STOPS) for _ in range(4)])
    disturb_reconstruction(
        tmp_path / "reconstruct", recording, seed, [draw.choice(STOPS) for _ in range(4)]
    )
    (tmp_path / "write").mkdir()
    disturb_writing(tmp_path / "write", seed, 10)
