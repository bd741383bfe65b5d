"""What a user meets at an entry point: one line and exit code 2, a checkpoint after Ctrl-C."""

import logging
import os
import re
import runpy
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException

from src.app import entry_point
from src.app.entry_point import run_main
from tests.conftest import ROOT
from tests.faults.harness import Run, run_entry_point, run_program
from tests.faults.test_kills import resolved

SCRIPTS = [
    file
    for folder in ("scripts", "benchmarks")
    for file in sorted((ROOT / folder).rglob("*.py"))
    if '__name__ == "__main__"' in file.read_text()
]
TINY = ["debug=fdr", "loss=l1", "metrics.lpips=null", "logger=none"]


def run_here(entry_point: str, *overrides: str) -> int:
    """Run `python -m src.<entry_point>` in this process, and return its exit code."""
    return run_file(ROOT / "src" / f"{entry_point}.py", *overrides)


def run_file(file: Path, *words: str) -> int:
    """Run a file as the main program in this process, and return its exit code."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("HYDRA_FULL_ERROR", "1")
        patched.setattr(sys, "argv", [str(file), *words])
        try:
            runpy.run_path(str(file), run_name="__main__")
        except SystemExit as end:
            return end.code
        finally:
            root.handlers[:] = handlers
            root.setLevel(level)
    return 0


@pytest.mark.parametrize("file", SCRIPTS, ids=lambda file: str(file.relative_to(ROOT)))
def test_every_script_prints_its_help_and_refuses_an_unknown_option(file, capsys):
    assert run_file(file, "--help") == 0
    assert re.search("usage: |Powered by Hydra", capsys.readouterr().out)
    assert run_file(file, "--no-such-option") == 2
    assert "usage: " in capsys.readouterr().err


@pytest.fixture(scope="module")
def program() -> list[str]:
    """What a program says that uses the package, then imports what neither trains nor scores:
    whether its own errors are shown, and the modules."""
    commands = "calibrate convert live reconstruct report simulate"
    code = (
        "import sys, lightfield_events as l; l.layout; "
        "print(sys.excepthook is sys.__excepthook__); "
        f"import src.{commands.replace(' ', ', src.')}; print(*sys.modules)"
    )
    ask = {"capture_output": True, "text": True, "check": True, "cwd": ROOT}
    return subprocess.run([sys.executable, "-c", code], **ask).stdout.splitlines()


def test_only_what_trains_and_scores_loads_lightning_and_torchmetrics(program):
    """They, and the writer of RAW files, take as long to load as all else that a command needs."""
    assert not {"lightning", "torchmetrics", "faery"} & set(program[-1].split())


def test_a_program_that_uses_the_package_keeps_its_own_errors(program):
    assert program[0] == "True"


def test_a_wrong_value_is_one_line_and_exit_code_2_of_the_process(tmp_path):
    words = [*TINY, "data.crop=1000", f"paths.out={tmp_path}"]
    run = Run(tmp_path / "log", run_program, "train", *words, program=True)
    assert run.wait() == 2, run.text()
    (line,) = [line for line in run.text().splitlines() if line.startswith("error: ")]
    assert "data.crop must be in 8..72" in line and "Traceback" not in run.text()
    assert not list(tmp_path.rglob("results.json"))


def test_a_typed_folder_of_a_run_is_refused_with_the_key_that_sets_it(tmp_path, capsys):
    words = ["videos=[a]", f"paths.run={tmp_path}/x", f"paths.out={tmp_path}"]
    assert run_here("compare", *words) == 2
    said = "paths.run must be set as hydra.run.dir=FOLDER"
    assert said in capsys.readouterr().err and not (tmp_path / "x").exists()


@pytest.mark.parametrize("below", ["", "/run"])
def test_a_file_where_the_folder_of_a_run_should_be_is_one_line(below, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("kept")
    folder = f"{tmp_path}/notes.txt{below}"
    wanted = f"hydra.run.dir must be a folder, new or there, got {folder}: a file is in the way"
    assert run_here("report", "run=out", f"hydra.run.dir={folder}") == 2
    assert capsys.readouterr().err.strip() == f"error: {wanted}"
    assert (tmp_path / "notes.txt").read_text() == "kept"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs Linux")
def test_a_folder_of_a_run_that_cannot_be_made_is_one_line(capsys):
    wanted = "hydra.run.dir must be a folder, new or there, got /proc/nope: it cannot be made there"
    assert run_here("report", "run=out", "hydra.run.dir=/proc/nope") == 2
    assert capsys.readouterr().err.strip() == f"error: {wanted}"


@pytest.mark.parametrize("command", [["-m", "src.train"], ["-m", "lightfield_events", "train"]])
def test_ctrl_c_while_modules_are_imported_is_one_line(command, tmp_path):
    (tmp_path / "torch.py").write_text("raise KeyboardInterrupt\n")  # found before the package
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    ask = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-P", *command], **ask)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "stopped\n")  # of a shell: 130


def warn_of_files() -> None:
    """Warn as from a file of ours and as from one of another package."""
    for file in (entry_point.__file__, "/site-packages/other.py"):
        warnings.warn_explicit(f"late in {file}", UserWarning, file, 3)


def test_a_warning_of_ours_is_one_line(tmp_path):
    run = Run(tmp_path / "log", warn_of_files)
    assert run.wait() == 0
    ours, other = run.text().splitlines()
    assert ours.startswith("warning: late in /")
    assert other.startswith("/site-packages/other.py:3: UserWarning: ")


def test_ctrl_c_later_is_one_line_and_exit_code_130(monkeypatch, capsys):
    def stop() -> None:
        raise KeyboardInterrupt

    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", ["reconstruct.py"])
    with pytest.raises(SystemExit) as end:
        run_main(stop)
    assert end.value.code == 130 and capsys.readouterr().err == "stopped\n"


def test_what_lightning_refuses_is_one_line(capsys):
    def refuse():
        raise MisconfigurationException("`monitor`\n is missing")

    with pytest.raises(SystemExit) as end:
        run_main(refuse)
    assert end.value.code == 2 and capsys.readouterr().err == "error: `monitor` is missing\n"


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_leaves_a_checkpoint_that_loads(stop, tmp_path):
    many = ["trainer.max_steps=100000", "data.epoch_clips=100000"]
    many += ["callbacks.rotation.every_n_train_steps=2"]
    run = Run(tmp_path / "log", run_entry_point, "train", resolved("train", tmp_path, *TINY, *many))
    try:
        assert run.wait_until(lambda: any(tmp_path.rglob("every*.ckpt"))), run.text()
        assert run.stop(stop) in (-stop, 128 + stop)
    finally:  # or it trains on when a test has failed
        run.process.kill()
    (last,) = tmp_path.rglob("last.ckpt")
    content = torch.load(last, weights_only=True)
    assert content["global_step"] > 0 and content["network"]["target"].endswith("E2VID")


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
