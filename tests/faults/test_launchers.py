"""A sweep runs through every launcher that is installed, each job in its folder."""

import importlib.util
import json
import os
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tests.test_train import TINY

LAUNCHERS = {
    "joblib": ["hydra.launcher.n_jobs=2"],
    "submitit_local": ["hydra.launcher.timeout_min=20"],
    "ray": [],
}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_sweep_runs(launcher, tmp_path):
    package = f"hydra_plugins.hydra_{launcher.removesuffix('_local')}_launcher"
    try:
        found = importlib.util.find_spec(package)
    except ModuleNotFoundError:
        found = None
    if found is None:
        pytest.skip(f"{package} is not installed: pip install -e .[{launcher.split('_')[0]}]")
    sweep = [f"hydra/launcher={launcher}", *LAUNCHERS[launcher], "seed=0,1", *TINY, "logger=none"]
    small = ["turbulence=none", "optics=single", f"paths.out={tmp_path}"]
    done = subprocess.run(
        [sys.executable, "-m", "src.train", "-m", *sweep, *small],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    records = [json.loads(path.read_text()) for path in sorted(tmp_path.rglob("results.json"))]
    assert sorted(record["seed"] for record in records) == [0, 1]
