"""What a user sees: help with comments, progress, names of methods, one line at Ctrl-C."""

import io
import os
import pty
import re
import select
import subprocess
import sys
import time
import warnings
from unittest.mock import Mock

import pytest
import torch
from lightning import Trainer
from rich.console import Console

from src.app import entry_point, help, methods
from src.app.before_imports import refuse_wrong_overrides
from src.app.help import help_text
from src.records.results import ScoreRow, build_rich_score_table, describe_score_difference
from src.training.progress import TrainingProgress
from tests.conftest import ROOT
from tests.faults.harness import Run, run_program
from tests.test_entry_points import run_here
from tests.test_train import config

SMALL = [
    "experiment=lf3x3", "data.crop=32", "data.test_crop=32", "data.windows=3", "data.loss_from=0",
    "data.test_windows=4", "data.test_clips=1", "data.val_clips=1", "data.epoch_clips=8", "width=8",
    "data.batch_size=2", "data.cache_clips=null", "trainer.max_steps=5000", "loss=l1",
    "metrics.lpips=null", "data.unscored_windows=0", "data.workers=1", "turbulence=none",
]  # fmt: skip


def test_help_shows_keys_with_their_comments_and_the_choices_of_groups():
    text = help_text("reconstruct", "What it does.\n")
    assert text.startswith("What it does.\n")
    assert re.search(r"^recording: required +# an event file", text, re.M)
    assert re.search(r"^playback_fps: 30.0 +# frames per second at which", text, re.M)
    assert "defaults:" not in text and "paths" not in text.splitlines()[3]
    groups = help_text("simulate", "")
    assert re.search(
        r"^  turbulence=mixed +or extreme, measured, medium, none, recorded, strong", groups, re.M
    )


def test_help_shows_no_group_of_one_choice_but_its_keys():
    text = help_text("reconstruct", "")
    assert "reading=" not in text and re.search(r"^time_unit: auto +# auto, s, ms", text, re.M)
    text = help_text("train", "")
    assert "callbacks=" not in text and text.count("fine_tuning") == 1
    assert "target.rows" in help_text("calibrate", "")


def test_help_of_the_installed_package_has_its_command(monkeypatch):
    monkeypatch.setattr(help, "COMMAND", "lightfield-events ")
    text = help_text("reconstruct", "To video: python -m src.reconstruct recording=cap.raw\n")
    assert text.startswith("To video: lightfield-events reconstruct recording=cap.raw\n")


@pytest.mark.parametrize("command", ["simulate", "train"])
def test_every_command_has_help(command, capsys):
    assert run_here(command, "--help") == 0
    said = capsys.readouterr().out
    assert "seed: 0  " in said and f"python -m src.{command}" in said


def run_and_list_imports(*words: str) -> tuple[subprocess.CompletedProcess[str], set[str]]:
    """Run `python -m` with `words`; return what it gave and the modules it imported."""
    command = [sys.executable, "-X", "importtime", "-m", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return done, {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}


def test_help_comes_before_the_imports_of_a_command():
    done, loaded = run_and_list_imports("src.train", "--help")
    assert done.stdout.startswith("Train a network") and "seed: 0  " in done.stdout
    assert "src.app.help" in loaded and not loaded & {"torch", "lightning", "hydra", "src.train"}


@pytest.mark.parametrize("command", [["src.train"], ["lightfield_events", "train"]])
def test_a_wrong_value_is_refused_before_the_imports_of_a_command(command):
    done, loaded = run_and_list_imports(*command, "experiment=lf3x3", "width=abc")
    assert done.returncode == 2
    assert "error: width must be a whole number, got abc\n" in done.stderr
    assert "hydra" in loaded and not loaded & {"torch", "lightning", "src.train"}


def test_options_of_hydra_are_not_looked_at_before_imports():
    refuse_wrong_overrides("train", ["width=1,2", "-m"])
    refuse_wrong_overrides("simulate", ["--config-name", "demo", "write=a.raw"])
    refuse_wrong_overrides("train", ["hydra.mode=MULTIRUN", "width=1,2"])
    refuse_wrong_overrides("train", ["hydra.searchpath=[file://mine]", "experiment=mine"])
    refuse_wrong_overrides("train", ["+hydra/launcher=joblib", "experiment=mine"])
    for words in (["width=1,2"], ["hydra.run.dir=out/a", "width=1,2"]):
        with pytest.raises(SystemExit):
            refuse_wrong_overrides("train", words)


@pytest.mark.parametrize(
    "given, name",
    [
        (["ckpt=setnet_small"], "setnet_small"),
        (["ckpt=out/a/step5.ckpt"], "step5"),
        (["ckpt=clean/etnet", "name=mine"], "mine"),
        (["baseline=highpass"], "HighPass"),
    ],
)
def test_a_table_names_the_method_asked_for(given, name, tmp_path):
    assert methods.method_name(config("eval", tmp_path, *given)) == name


def test_a_table_cuts_no_name_and_no_number():
    scores = {"ssim": 0.512, "psnr": 16.25}
    scores |= {"lpips": 0.3, "psnr_aligned": 20.1, "temporal_jitter_px": 0.85}
    row = ScoreRow("single256 given 9 views, before training", [scores], 1, 1, {"a": 103.2})
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(build_rich_score_table([row]))
    text = console.export_text()
    first, second = text.splitlines()[-2:]
    assert f"{first[:24]} {second.strip()}" == row.name
    assert first.split()[-6:] == ["0.300", "0.512", "16.25", "20.10", "0.85", "103.2"]


def test_a_difference_that_may_be_none_is_said_to_be_none():
    ours, less, more = (
        ScoreRow(name, [{"lpips": value} for value in values], 1, 1, {})
        for name, values in {"a": (0.3, 0.2), "b": (0.1, 0.3), "c": (0.5, 0.5)}.items()
    )
    none = "LPIPS, a less b: +0.0500, 95 % CI -0.1000 to +0.2000: it holds 0, so no difference is"
    assert describe_score_difference(ours, less) == f"{none} shown"
    said = "LPIPS, a less c: -0.2500, 95 % CI -0.3000 to -0.2000"
    assert describe_score_difference(ours, more) == said


def test_progress_counts_the_steps_asked_for(capsys):
    shown = TrainingProgress(tested="untrained")
    trainer = Mock(spec=Trainer, max_steps=30, num_test_batches=[2])
    shown.on_train_start(trainer, None)
    for step in range(1, 31):
        trainer.global_step, trainer.progress_bar_metrics = step, {"train/loss": 0.5}
        shown.on_train_batch_end(trainer, None, None)
    shown.on_train_end(trainer, None)
    shown.on_test_start(trainer, None)
    for _ in range(2):
        shown.on_test_batch_end(trainer, None)
    shown.on_test_end(trainer, None)
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["training: step 30 of 30 loss 0.500", "testing untrained: 2 of 2"]


def test_the_last_clip_is_printed_once_however_long_it_took(capsys, monkeypatch):
    monkeypatch.setattr("src.training.progress.LINE_EVERY_S", -1.0)
    shown = TrainingProgress(tested="it")
    trainer = Mock(spec=Trainer, num_test_batches=[2])
    shown.on_test_start(trainer, None)
    for _ in range(2):
        shown.on_test_batch_end(trainer, None)
    shown.on_test_end(trainer, None)
    assert capsys.readouterr().out.splitlines() == ["testing it: 1 of 2", "testing it: 2 of 2"]


def read_until(terminal: int, word: bytes, seconds: float) -> bytes:
    """Return what a terminal shows until `word` is there or it closes."""
    seen, end = b"", time.monotonic() + seconds
    while word not in seen and time.monotonic() < end:
        if select.select([terminal], [], [], 1)[0]:
            try:
                seen += os.read(terminal, 65536)
            except OSError:
                break
    return seen


@pytest.mark.slow
def test_of_an_error_in_a_worker_the_line_is_printed(capsys, monkeypatch):
    class Broken(torch.utils.data.Dataset):
        def __len__(self):
            return 1

        def __getitem__(self, index):
            raise ValueError("scene.root must hold photographs, got a.png")

    loader = torch.utils.data.DataLoader(Broken(), num_workers=1)
    monkeypatch.setattr(sys, "argv", ["train"])
    with pytest.raises(SystemExit) as ended:
        entry_point.run_main(lambda: next(iter(loader)))
    said = capsys.readouterr().err
    assert said == "error: scene.root must hold photographs, got a.png\n" and ended.value.code == 2


def train_at_terminal(name: str, *words: str) -> None:
    """Run src.train with the terminal `name` as that of its process."""
    os.setsid()
    terminal = os.open(name, os.O_RDWR)  # which is now that of the session
    for number in range(3):
        os.dup2(terminal, number)
    sys.stdout, sys.stderr = (
        os.fdopen(number, "w", buffering=1, closefd=False) for number in (1, 2)
    )
    warnings.simplefilter("ignore")
    run_program("train", *words)


def test_ctrl_c_at_a_terminal_ends_in_one_line(tmp_path):
    words = [*SMALL, f"hydra.run.dir={tmp_path}"]
    terminal, of_child = pty.openpty()
    run = Run(tmp_path / "log", train_at_terminal, os.ttyname(of_child), *words, program=True)
    try:
        before = read_until(terminal, b"\n", 400)
        os.close(of_child)  # now the run alone holds it, so that the terminal closes with it
        before += read_until(terminal, b" of 5000 loss", 400)
        os.write(terminal, b"\x03")
        after = read_until(terminal, b"never", 100).decode()
        code = run.wait(100)
    finally:  # or it trains on when a test has failed
        run.process.kill()
        os.close(terminal)
    assert b"testing untrained" in before and code == 130
    assert "Traceback" not in after and "DataLoader" not in after
    assert len(re.findall(r"stopped at step \d+; go on with ckpt=", after)) == 1
