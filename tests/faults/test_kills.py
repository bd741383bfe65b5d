"""Killed, terminated or interrupted anywhere, a run goes on to the numbers of one left alone."""

import json
import os
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from src.models import files
from src.models.checkpoints import is_intact, newest_checkpoint
from src.models.e2vid import E2VID
from src.recordings.files.event_file import EVENT
from src.recordings.files.event_writers import write_events
from src.records import results
from src.records.results import ScoreRow
from tests.faults import harness
from tests.faults.harness import Run, Tally, run_entry_point
from tests.test_train import TINY, config

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
STEPS = 12
STEADY = [
    *TINY, "logger=none", f"trainer.max_steps={STEPS}", "data.epoch_clips=4",
    "augment.noise_std=0.1", "callbacks.rotation.every_n_train_steps=3", "turbulence=none",
    "optics=single",
]  # fmt: skip
EVALUATION = [
    "scene.height=64", "scene.width=64", "data.test_clips=2", "data.test_windows=3",
    "data.unscored_windows=1", "data.workers=0", "metrics.lpips=null", "baseline=highpass",
    "turbulence=none",
]  # fmt: skip
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 9))]


def resolved(name: str, run: Path, *overrides: str) -> str:
    return OmegaConf.to_yaml(config(name, run, *overrides), resolve=True)


def training(run: Path, *more: str) -> str:
    return resolved("train", run, *STEADY, *more)


def signals(seed: int, first: list[int], count: int) -> list[int]:
    """Return `first` for seed 0, else `count` signals drawn at random."""
    draw = random.Random(seed)
    return first if seed == 0 else [draw.choice(SIGNALS) for _ in range(count)]


def was_stopped(run: Run, number: int, after_s: float) -> bool:
    """Stop a run after so many seconds; return whether it was still there."""
    end = time.monotonic() + after_s
    run.wait_until(lambda: time.monotonic() > end)
    code = run.stop(number)
    assert code in (0, -number, 128 + number), run.text()
    return code != 0


def disturb_training(
    folder: Path, stops: list[int], draw: random.Random, seconds: float, tally: Tally
) -> dict:
    """Stop a training again and again, each time going on from the newest checkpoint there is."""
    left: list[str] = []
    for k, number in enumerate(stops):
        run = Run(folder / f"log{k}", run_entry_point, "train", training(folder / f"run{k}", *left))
        if not was_stopped(run, number, draw.uniform(0.1, 0.7 * seconds)):
            return harness.outcome(folder / f"run{k}")
        tally.injected += 1
        checkpoints = list(folder.rglob("*.ckpt"))
        if "stopped at step" in run.text():
            assert f"go on with ckpt={folder / f'run{k}/checkpoints'}" in run.text()
        assert all(is_intact(path) for path in checkpoints)
        left = [f"ckpt={newest_checkpoint(folder)}"] if checkpoints else []
    run = Run(folder / "log", run_entry_point, "train", training(folder / "last", *left))
    assert run.wait() == 0, run.text()
    return harness.outcome(folder / "last")


@pytest.mark.filterwarnings("ignore:.* runs, the newest is taken")
@pytest.mark.parametrize("seed", SEEDS)
def test_training_goes_on_to_the_same_numbers(tmp_path, alone, seed):
    numbers, seconds = alone
    stops = signals(seed, [signal.SIGTERM, signal.SIGINT, signal.SIGKILL], 6)
    tally, draw = Tally(f"training, seed {seed}"), random.Random(seed)
    with tally.run():
        while not tally.injected:  # on a machine that got faster it may end before it is stopped
            folder = tmp_path / f"{seconds:.3f}"
            assert disturb_training(folder, stops, draw, seconds, tally) == numbers
            seconds /= 2


def train_and_stop_in_validation(config: str, number: int) -> None:
    """Run src.train; a signal comes while the first clip is validated at step 4."""
    from src.training.reconstructor import Reconstructor

    validate = Reconstructor.validation_step

    def step(self, sample, batch_idx: int) -> None:
        validate(self, sample, batch_idx)
        if self.global_step == 4 and batch_idx == 0:
            os.kill(os.getpid(), number)

    Reconstructor.validation_step = step
    run_entry_point("train", config)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_training_stopped_while_it_validates_goes_on_to_the_same_numbers(tmp_path, alone, number):
    numbers, _ = alone  # in which the averaged weights stand in for those in training
    tally = Tally("training, stopped while it validates")
    with tally.run():
        tally.injected += 1
        first = training(tmp_path / "first", "data.val_clips=3")
        run = Run(tmp_path / "log", train_and_stop_in_validation, first, int(number))
        assert run.wait() != 0 and "stopped at step 4" in run.text(), run.text()
        rest = training(tmp_path / "rest", "data.val_clips=3", f"ckpt={tmp_path / 'first'}")
        again = Run(tmp_path / "rest.log", run_entry_point, "train", rest)
        assert again.wait() == 0, again.text()
        assert harness.outcome(tmp_path / "rest") == numbers


def stop_and_repeat(
    folder: Path, name: str, overrides: list[str], seed: int, stops: list[int], tally: Tally
) -> list[Path]:
    """Stop an entry point at random moments and repeat it; return an undisturbed run and this."""
    start, draw = time.monotonic(), random.Random(seed)
    alone = resolved(name, folder / "alone", *overrides)
    assert Run(folder / "log", run_entry_point, name, alone).wait() == 0
    seconds = time.monotonic() - start
    given = resolved(name, folder / "stopped", *overrides)
    for k, number in enumerate(stops):
        run = Run(folder / f"log{k}", run_entry_point, name, given)
        tally.injected += was_stopped(run, number, draw.uniform(0.1, seconds))
    run = Run(folder / "final", run_entry_point, name, given)
    assert run.wait() == 0, run.text()
    return [folder / "alone", folder / "stopped"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(9))
def test_evaluation_repeats_its_numbers(tmp_path, seed):
    tally, stops = Tally(f"evaluation, seed {seed}"), signals(seed, [signal.SIGTERM], 4)
    with tally.run():
        runs = stop_and_repeat(tmp_path, "eval", EVALUATION, seed, stops, tally)
        first, second = map(harness.outcome, runs)
        assert first == second


@pytest.mark.parametrize("seed", SEEDS)
def test_reconstruction_repeats_its_frames(tmp_path, seed):
    g = np.random.default_rng(0)
    events = np.zeros(60_000, EVENT)
    events["t"] = np.sort(g.integers(0, 1_000_000, len(events)))
    events["x"], events["y"] = g.integers(0, 32, (2, len(events)))
    events["p"] = g.choice([-1, 1], len(events))
    write_events(tmp_path / "cap.raw", events, width=32, height=32)
    spec = {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 1, "base_channels": 4}}
    files.save(tmp_path / "net.safetensors", E2VID(**spec["kwargs"]), spec, {})
    given = [
        f"recording={tmp_path}/cap.raw",
        f"ckpt={tmp_path}/net.safetensors",
        "output_format=png",
    ]
    tally, stops = Tally(f"reconstruction, seed {seed}"), signals(seed, [signal.SIGINT], 4)
    with tally.run():
        runs = stop_and_repeat(tmp_path, "reconstruct", given, seed, stops, tally)
        first, second = (
            {file.name: file.read_bytes() for file in run.rglob("frames*/*.png")}
            | {"frames.csv": (run / "frames.csv").read_bytes()}
            for run in runs
        )
        assert first == second and len(first) > 100


def write_results_forever(run: str) -> None:
    clips = [{"name": f"clip{n}", "psnr": 20.0 + n, "ssim": 0.5} for n in range(300)]
    row = ScoreRow("net", clips, params=1, macs_per_frame=1, latency_ms_by_size={"64x64": 1.0})
    for seed in range(10**9):
        results.write_and_print_results(
            Path(run), "a: 1", [row], task="train", experiment="x", seed=seed
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_results_are_whole_whenever_the_writer_dies(tmp_path, seed):
    draw, tally, run = random.Random(seed), Tally("results.json"), tmp_path / "run"
    run.mkdir()
    with tally.run():
        for _ in range(3 if seed == 0 else 10):
            work = Run(tmp_path / "log", write_results_forever, str(run))
            work.wait_until(lambda work=work: "300 test clips" in work.text())
            was_stopped(work, draw.choice(SIGNALS), draw.uniform(0, 0.1))
            tally.injected += 1
            record = json.loads((run / "results.json").read_text())
            assert record["test"]["clips"] == 300
            assert len((run / "clips.csv").read_text().splitlines()) == 301
