"""Filling a cache with processes that draw: what is made, how it ends, and what is reported."""

import gc
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from scripts.lease import fill as lease_fill
from scripts.lease.plan import Fill
from scripts.lease.probe import Device, Trial
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline, crop_frames
from src.sim.sensor import EventSensor
from src.training import parallel_fill
from src.training.clip_cache import CachedClip, CachedPipeline, DeviceClipCache
from src.training.disk_cache import DiskClipCache
from src.training.parallel_fill import FillReport, fill
from tests.faults.harness import FORKS, Run
from tests.sim.test_pipeline import Waves
from tests.training.cache_sources import Broken, Growing, Other, Telling, fill_for_ever, source
from tests.training.test_disk_cache import runs, until


@pytest.fixture
def imported(monkeypatch) -> None:
    """Let those who draw be forked from a process that has imported all they need."""

    monkeypatch.setattr(parallel_fill, "_forkserver", lambda: FORKS)


def made(of: Pipeline, indices: Iterable[int], **kw) -> tuple[dict[int, CachedClip], FillReport]:
    """Return what is stored, in order, and the report."""
    stored: dict[int, CachedClip] = {}
    report = fill(of, indices, stored.__setitem__, **{"device": "cpu", "workers": 1} | kw)
    return stored, report


def nobody_draws() -> bool:
    gc.collect()  # an error that is still somewhere holds the loader
    return not multiprocessing.active_children()


def test_clips_are_those_of_a_disk_cache_and_drawn_without_the_device(imported, tmp_path):
    of = source(Telling(tmp_path / "told"))
    stored, report = made(of, range(7), workers=2)
    assert (tmp_path / "told").read_text() == "False ''"
    cache = DiskClipCache(source(), tmp_path, {}, clips=7, frames=7, gib=1.0)
    assert list(stored) == list(range(7)) and report.clips == 7
    for index, (views, clean, metadata) in stored.items():
        clip = cache.clip(index)
        assert torch.equal(views, clip.views) and torch.equal(clean, clip.clean)
        assert views.dtype == clean.dtype == torch.float16
        assert json.loads(json.dumps(metadata)) == clip.metadata
        assert metadata["record"]["temporal_model"] != "mixed"  # that of the clip


def test_turbulence_that_is_prepared_elsewhere_gives_the_same_clips(imported, monkeypatch):
    """As for a GPU: turbulence comes from those who draw, and all views are computed at once."""
    of = source(Growing(frames=7))
    monkeypatch.setattr(parallel_fill, "prepares_turbulence", lambda device: True)
    for index, (views, *_) in made(of, range(6))[0].items():
        expected = of.render_views([of.draw(index)])[0].half()
        assert views.dtype == torch.float16 and views.shape == expected.shape
        torch.testing.assert_close(views.float(), expected.float(), atol=1e-3, rtol=0)
        assert (views != expected).float().mean() < 0.02  # rounded the other way


def test_turbulence_that_cannot_be_prepared_is_computed_here_and_a_failure_named(
    imported, monkeypatch
):
    of, stored = source(turbulence=Other({"severity": "weak"})), {}
    monkeypatch.setattr(parallel_fill, "prepares_turbulence", lambda device: True)
    with pytest.raises(RuntimeError, match="clip 2: MemoryError: no room"):
        fill(of, range(6), stored.__setitem__, device="cpu", workers=1)
    assert list(stored) == [0, 1]
    expected = [of.render_views([of.draw(k)])[0].half() for k in stored]
    assert all(torch.equal(stored[k].views, expected[k]) for k in stored)


@pytest.mark.parametrize(
    ("killed", "error", "message"),
    [
        (False, ValueError, "clip 2: scene.root must hold readable photographs, got two.png"),
        (True, RuntimeError, "waiting for clip 2: a process that draws ended with exit code -9"),
    ],
)
def test_a_clip_that_cannot_be_drawn_is_an_error_and_nothing_hangs(
    killed, error, message, imported
):
    stored: dict[int, CachedClip] = {}
    with pytest.raises(error, match=message):
        fill(source(Broken(killed)), range(6), stored.__setitem__, device="cpu", workers=2)
    assert list(stored) == [0, 1]
    until(nobody_draws)


@pytest.mark.timeout(300)
def test_a_process_that_dies_in_the_middle_of_a_clip_is_an_error(imported):
    """A clip is more than a pipe holds: both processes wait in the middle of one for its reader."""
    of = source(Waves(frames=7, side=400))
    clips = parallel_fill.SimulatedClips(of, range(60), device="cpu", workers=2)
    next(clips)  # both have been started
    time.sleep(1)  # each has drawn its next clip and written what fits
    for process in multiprocessing.active_children():
        process.kill()
    with pytest.raises(RuntimeError, match="waiting for clip 1: .* exit code -9"):
        next(clips)
    until(nobody_draws)


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_that_is_no_refusal_says_its_kind(workers, imported):
    of = source()
    of.scene = None
    with pytest.raises(RuntimeError, match="clip 0: AttributeError: "):
        made(of, range(2), workers=workers)


def test_what_store_raises_ends_all_and_is_raised(imported):
    def store(*_) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fill(source(), range(9), store, device="cpu", workers=1)
    until(nobody_draws)


def test_it_stops_in_time_without_a_gap(imported, monkeypatch):
    stored: dict[int, CachedClip] = {}
    clock = SimpleNamespace(monotonic=lambda: len(stored))
    monkeypatch.setattr(parallel_fill, "time", clock)
    report = fill(source(), range(5, 10_000), stored.__setitem__, device="cpu", workers=2, until=3)
    assert list(stored) == [5, 6, 7] and report.clips == 3
    assert str(report).startswith("3 clips in ") and f"{report.clips_per_second:.1f}" in str(report)


def test_a_first_clip_that_comes_late_is_kept(imported):
    stored: dict[int, CachedClip] = {}
    report = fill(source(), range(9), stored.__setitem__, device="cpu", workers=0, until=0)
    assert list(stored) == [0] and report.clips == 1


def test_nothing_to_do_and_no_one_to_do_it():
    assert made(source(), [])[1].clips == 0
    with pytest.raises(ValueError, match="workers must be a whole number >= 0, got -1"):
        made(source(), range(3), workers=-1)


def drawing_for(told: Path) -> list[int]:
    """Return the numbers of the two processes that draw, once they do."""
    until(told.exists)
    drawing = [int(pid) for pid in told.read_text().split()]
    assert len(drawing) == 2 and all(map(runs, drawing))
    return drawing


def test_stopped_from_outside_all_end(tmp_path):
    told = tmp_path / "pids"
    call = f"from tests.training import cache_sources; cache_sources.fill_for_ever({str(told)!r})"
    asking = subprocess.Popen(
        [sys.executable, "-c", call], start_new_session=True, stderr=subprocess.DEVNULL
    )
    drawing = drawing_for(told)
    os.killpg(asking.pid, signal.SIGINT)  # Ctrl-C reaches all of them
    assert asking.wait(600) != 0
    until(lambda: not any(map(runs, drawing)))


def fill_and_end_at_once(told: str) -> None:
    """Fill for ever, in a process that a signal ends with nothing closed."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parallel_fill._forkserver = lambda: FORKS
    fill_for_ever(told)


def test_terminated_from_outside_all_end(tmp_path):
    told = tmp_path / "pids"
    asking = Run(tmp_path / "log", fill_and_end_at_once, str(told))
    drawing = drawing_for(told)
    assert asking.stop(signal.SIGTERM) == -signal.SIGTERM
    until(lambda: not any(map(runs, drawing)))


def lease_cache() -> DeviceClipCache:
    return DeviceClipCache(source(), device="cpu", clips=3, frames=7, gib=1.0)


def fill_for_lease(cache: DeviceClipCache, workers: int, log=print) -> dict[str, float]:
    plan = Fill(minutes=0.5 if workers else 0.05, clips=7, warn_below_clips=1, workers=workers)
    device = Device("cpu", "a CPU", 2**33, False, False)
    return lease_fill.fill_caches([cache], plan, device, Trial(2), log)[0]


@pytest.mark.parametrize("dies", [False, True])
def test_where_processes_make_no_clip_the_lease_draws_itself(dies, monkeypatch):
    tried, said = [], []

    def store_clips(clips, store, **_) -> FillReport:
        tried.append(clips.workers)
        if clips.workers and dies:
            raise RuntimeError("waiting for clip 0: a process died")
        return FillReport(clips=0 if clips.workers else 2, seconds=1.0, waiting_s=0.0)

    def simulated_clips(*_, workers, **__) -> SimpleNamespace:
        return SimpleNamespace(workers=workers, close=lambda: None)

    monkeypatch.setattr(lease_fill, "store_clips", store_clips)
    monkeypatch.setattr(lease_fill, "SimulatedClips", simulated_clips)
    report = fill_for_lease(cache := lease_cache(), 4, said.append)
    assert tried == [4, 0] and cache.clips == report["clips"] == 2
    assert said[dies].startswith("cache: no clip by 4 processes in 30 s")


def test_a_clip_that_fails_in_the_lease_itself_is_named(monkeypatch):
    def fails(*_, **__):
        raise RuntimeError("clip 3: no light")

    monkeypatch.setattr(lease_fill, "store_clips", fails)
    with pytest.raises(RuntimeError, match="clip 3: no light"):
        fill_for_lease(lease_cache(), 0)


def test_a_lease_renews_its_clips_the_oldest_first(imported):
    said, cache = [], lease_cache()
    assert fill_for_lease(cache, 1, said.append)["clips"] == 3
    draws = [CachedPipeline(cache, Optics(9), EventSensor(), windows=4, crop=8).draw(0)]
    expected = cache.source.draw
    for later in range(3, 7):
        cache.read_views(draws, "cpu")
        clean = crop_frames(expected(later).clip.frames, expected(later).crop).half()
        assert torch.equal(cache.clip(later % 3).clean, clean)
    cache.clear()
    assert said[-1].startswith("cache: 4 clips renewed")
    until(nobody_draws)


def test_a_clip_that_fails_later_ends_the_renewal_but_not_the_training(imported):
    said: list[str] = []
    cache = DeviceClipCache(source(Broken(False)), device="cpu", clips=2, frames=7, gib=1.0)
    fill_for_lease(cache, 1, said.append)
    draws = [CachedPipeline(cache, Optics(9), EventSensor(), windows=4, crop=8).draw(0)]
    before = cache.read_views(draws, "cpu")
    assert torch.equal(cache.read_views(draws, "cpu"), before)
    assert "cache: renewed no more: clip 2: scene.root must hold readable photographs" in said[-2]
