"""Annotations of `src` and `baselines` are checked while the tests run; shared fixtures."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jaxtyping
import pytest
import torch
from hydra.core.hydra_config import HydraConfig

import src  # noqa: F401 - sets OpenCV's limits before a test imports it
from tests.configs import remember_configs
from tests.faults.harness import leave_slices_out
from tests.typecheck import check_annotations

ROOT = Path(__file__).resolve().parents[1]
# A shell starts what runs in its background with Ctrl-C ignored, and so would be what tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def checked_modules() -> list[str]:
    """Return the modules of the packages; not the entry points and src/app, which see configs
    instead of tensors, nor the `engines` packages, whose kernels a wrapper would not compile.
    """
    files = [*(ROOT / "src").glob("*/**/*.py"), *(ROOT / "baselines").rglob("*.py")]
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files]
    left_out = ("src.app.", ".engines.", ".__init__")
    return [name for name in names if not any(part in f"{name}." for part in left_out)]


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    """Make tensors of `dtype` where nothing else is asked for."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


jaxtyping.jaxtyped = check_annotations  # what the hook decorates everything with
jaxtyping.install_import_hook(checked_modules(), "tests.typecheck.check")


@pytest.fixture(autouse=True, scope="session")
def configs_are_composed_once():
    """Also where a test, a fixture or what is tested does it again."""
    with pytest.MonkeyPatch.context() as patched:
        remember_configs(patched)
        yield


@pytest.fixture(autouse=True, scope="session")
def no_slices():
    """Trainings and evaluations draw no slices, which take longer than they do themselves; those of
    test_readme.py do."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("src.figures.samples.draw_comparison", leave_slices_out)
        yield


@pytest.fixture(autouse=True, scope="session")
def one_timed_frame():
    """Trainings and evaluations time one frame of a network, not the fastest of several."""
    from src.deploy import cost

    def time_one_frame(network: torch.nn.Module, voxels: torch.Tensor, **how) -> cost.Timing:
        with pytest.MonkeyPatch.context() as fewer:
            fewer.setattr(cost, "TIMED_FRAMES", 1)
            return cost.time_frame(network, voxels, **how)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("src.training.evaluation.time_frame", time_one_frame)
        yield


@pytest.fixture(autouse=True)
def no_hydra_left():
    """What a test began by Hydra in this process is not what the next is run by."""
    yield
    HydraConfig.instance().cfg = None


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of photographs and recordings beside the checkout, or skip."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no data folder at {folder}")
    return folder
