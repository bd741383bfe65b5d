"""src.stress at a tiny size: map, table and text; what cannot run says why."""

import csv
import multiprocessing
import signal
import threading
import time
from pathlib import Path

import pytest

from src import stress as stress_module
from src.stress import stress
from tests.faults.harness import FORKS, Run
from tests.test_train import config
from tests.training.test_disk_cache import runs, until

HIGHPASS = "{baseline: {_target_: baselines.highpass.HighPass, view_reduction: median}, views: 9}"
ABSENT = "{ckpt: nowhere, views: 9}"
SETNET = "{ckpt: nowhere, views: 9, model: {_target_: src.models.setnet.SetNet}}"
PACKAGE = "src.bench.stress_tests"
FUNCTIONS = {
    "retention": (
        "recurrence.measure_contrast_retention_percent, windows: [2, 4], limit_percent: 90"
    ),
    "dropout": "conditions.measure_worst_view_dropout_loss, counts: [1], draws: 1, limit_db: 0.5",
    "fast": "conditions.measure_window_rate_loss, rates_hz: [1200], limit_db: 1.0",
}
ROWS = [
    f"{name}: {{title: {name}, test: {{_target_: {PACKAGE}.{function}}}}}"
    for name, function in FUNCTIONS.items()
]
TESTS = "{" + ", ".join(ROWS) + "}"
TINY = ["clips=1", "scene.height=64", "scene.width=64", "data.test_crop=32", "data.test_windows=20"]
TINY += ["data.unscored_windows=2", "processes=1", f"+stress_tests={TESTS}"]


def tiny(tmp_path, *overrides: str):
    return config("stress", tmp_path, "~stress_tests", "~networks", *TINY, *overrides)


def test_map_table_and_text_are_written(tmp_path):
    networks = f"+networks={{median: {HIGHPASS}, absent: {ABSENT}, untrained: {SETNET}}}"
    found = stress(tiny(tmp_path, networks))
    assert found["retention"]["median"].failed
    assert (
        "nowhere" in found["retention"]["absent"]
        and "no weights" in found["retention"]["untrained"]
    )
    assert all((tmp_path / f"stress.{suffix}").is_file() for suffix in ("png", "svg", "csv", "md"))
    lines = list(csv.DictReader((tmp_path / "stress.csv").read_text().splitlines()))
    assert {line["network"] for line in lines} == {"median", "absent", "untrained"}
    text = (tmp_path / "stress.md").read_text()
    assert "retention" in text and "Not run, because" in text


def test_titles_follow_the_arguments(tmp_path):
    title = "stress_tests.retention.title='{windows.last:,} windows'"
    one = "+networks={one: {baseline: {_target_: baselines.highpass.HighPass}, views: 1}}"
    typed = [one, title, "stress_tests.retention.test.windows=[5]"]
    stress(tiny(tmp_path, *typed, "~stress_tests.dropout", "~stress_tests.fast"))
    assert "5 windows" in (tmp_path / "stress.md").read_text()
    with pytest.raises(ValueError, match=r"^stress_tests\.fast\.title must name arguments of its"):
        stress(tiny(tmp_path / "b", one, "stress_tests.fast.title='{foo}'"))


def test_a_single_view_has_no_views_to_lose(tmp_path):
    networks = "+networks={one: {baseline: {_target_: baselines.highpass.HighPass}, views: 1}}"
    assert "centre view only" in stress(tiny(tmp_path, networks))["dropout"]["one"]


def test_a_checkpoint_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match="ckpt must be a file"):
        stress(tiny(tmp_path, "+networks={}", "ckpt=[nowhere]"))


def test_an_entry_of_networks_without_views_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"networks\.bad must have views"):
        stress(tiny(tmp_path, "+networks={bad: {ckpt: nowhere}}"))


def test_two_processes_find_what_one_does(tmp_path, monkeypatch):
    monkeypatch.setattr("src.stress.get_context", lambda _: FORKS)  # the imports are done
    one = "one: {baseline: {_target_: baselines.highpass.HighPass}, views: 1}"
    networks = f"+networks={{median: {HIGHPASS}, {one}}}"
    stress(tiny(tmp_path / "a", networks))
    stress(tiny(tmp_path / "b", networks, "processes=2"))
    texts = [(tmp_path / name / "stress.csv").read_text() for name in "ab"]
    assert texts[0] == texts[1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_processes_end_with_their_parent(tmp_path, number):
    run = Run(tmp_path / "log", stress_and_tell, tmp_path)
    pids = tmp_path / "pids"
    assert run.wait_until(pids.exists), run.text()
    testing = [int(pid) for pid in pids.read_text().split()]
    code = 128 + number if number == signal.SIGTERM else -number  # SIGKILL cannot be caught
    assert all(map(runs, testing)) and run.stop(number) == code
    until(lambda: not any(map(runs, testing)))


def stress_and_tell(folder: Path) -> None:
    """Test two networks in two processes, whose numbers are in the file `pids`, for ever."""
    stress_module.get_context = lambda _: FORKS

    def tell() -> None:
        while len(testing := multiprocessing.active_children()) < 2:
            time.sleep(0.01)
        part = folder / "part"  # renamed, so that nobody reads half of it
        part.write_text(" ".join(str(process.pid) for process in testing))
        part.rename(folder / "pids")

    threading.Thread(target=tell, daemon=True).start()
    networks = f"+networks={{one: {HIGHPASS}, other: {HIGHPASS}}}"
    stress(tiny(folder, networks, "processes=2"))
    time.sleep(600)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("processes=0", "processes must be >= 1, got 0"),
        ("clips=0", "clips must be >= 1, got 0"),
        ("data.test_windows=1", "data.test_windows must be >= 2, of which are scored, got 1"),
        ("data.test_windows=3", "data.unscored_windows must be in 0..1 .*, got 2"),
    ],
)
def test_numbers_that_leave_nothing_to_test_are_refused(tmp_path, wrong, message):
    with pytest.raises(ValueError, match=message):
        stress(tiny(tmp_path, "+networks={}", wrong))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            "stress_tests.fast.test.rates_hz=[100]",
            r"\.rates_hz must be such .*, got \[100\]",
        ),
        ("stress_tests.dropout.test.counts=[0]", r"\.counts must be whole .*, got \[0\]"),
        ("+stress_tests.fast.test.foo=1", " must have the test's own arguments: .*'foo'"),
        ("~stress_tests.fast.test.rates_hz", " must have the test's own arguments: .*'rates_hz'"),
    ],
)
def test_arguments_of_a_test_are_checked_before_it_runs(tmp_path, wrong, message):
    with pytest.raises(ValueError, match=r"^stress_tests\.\w*\.test" + message):
        stress(tiny(tmp_path, "+networks={}", wrong))
    assert not list(tmp_path.iterdir())
