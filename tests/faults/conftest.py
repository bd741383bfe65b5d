"""A training that nobody disturbs, for all tests that disturb one."""

import time

import pytest

from tests.faults import harness
from tests.faults.harness import Run
from tests.faults.test_kills import training


@pytest.fixture(scope="session")
def alone(tmp_path_factory) -> tuple[dict, float]:
    """The numbers of a training that nobody disturbs, and how many seconds it takes."""
    folder = tmp_path_factory.mktemp("alone")
    Run(folder / "nothing", int).wait()  # so that the server is up
    start = time.monotonic()
    run = Run(folder / "log", harness.run_entry_point, "train", training(folder / "run"))
    assert run.wait() == 0, run.text()
    return harness.outcome(folder / "run"), time.monotonic() - start
