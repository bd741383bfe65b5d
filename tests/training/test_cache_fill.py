"""Filling a cache with processes that draw: what is made, how it ends, and what is said."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterable
from types import SimpleNamespace

import pytest
import torch

from src.sim.pipeline import Pipeline
from src.training import cache_drawing, cache_fill
from src.training.bank import Bank
from src.training.cache_fill import FillReport, fill
from tests.training.filling import Broken, Growing, Other, Telling, source
from tests.training.test_bank import runs, until

Kept = dict[int, tuple[torch.Tensor, torch.Tensor, dict]]


def made(of: Pipeline, indices: Iterable[int], **kwargs) -> tuple[Kept, FillReport]:
    """Return what is kept, in order, and the report."""
    kept: Kept = {}

    def keep(index, *clip) -> None:
        kept[index] = clip

    return kept, fill(of, indices, keep, **{"device": "cpu", "workers": 1} | kwargs)


def test_clips_are_those_of_the_bank_and_drawn_without_the_device(tmp_path):
    of = source(Telling(tmp_path / "told"))
    kept, report = made(of, range(7), workers=2)
    assert (tmp_path / "told").read_text() == "False ''"
    bank = Bank(source(), tmp_path, {}, clips=7, frames=7, gib=1.0)
    assert list(kept) == list(range(7)) and report.clips == 7
    for index, (views, clean, facts) in kept.items():
        clip = bank.make(index)
        assert torch.equal(views, clip["views"]) and torch.equal(clean, clip["clean"])
        assert views.dtype == clean.dtype == torch.float16
        assert json.loads(json.dumps(facts)) == json.loads(clip["facts"])


def test_air_that_is_prepared_elsewhere_gives_the_same_clips(monkeypatch):
    """As for a GPU: the air comes from those who draw, and all views are computed at once."""
    of = source(Growing(frames=7))
    monkeypatch.setattr(cache_fill, "prepares", lambda device: True)
    for index, (views, *_) in made(of, range(6))[0].items():
        expected = of.views(of.draw(index))[0].half()
        assert views.dtype == torch.float16 and views.shape == expected.shape
        torch.testing.assert_close(views.float(), expected.float(), atol=1e-3, rtol=0)
        assert (views != expected).float().mean() < 0.02  # rounded the other way


def test_air_that_cannot_be_prepared_is_computed_here_and_what_fails_is_named(monkeypatch):
    of, kept = source(turbulence=Other({"severity": "weak"})), {}
    monkeypatch.setattr(cache_fill, "prepares", lambda device: True)
    with pytest.raises(RuntimeError, match="clip 2: MemoryError: no room"):
        fill(of, range(6), lambda index, *clip: kept.update({index: clip}), device="cpu", workers=1)
    assert list(kept) == [0, 1]
    assert all(torch.equal(kept[k][0], of.views(of.draw(k))[0].half()) for k in kept)


@pytest.mark.parametrize(
    ("killed", "error", "message"),
    [
        (False, ValueError, "clip 2: scene.root must hold readable photographs, got two.png"),
        (True, RuntimeError, r"clip 2: the process that draws it died \(exit code -9\)"),
    ],
)
def test_a_clip_that_cannot_be_drawn_is_named_and_nothing_hangs(killed, error, message):
    kept = []
    with pytest.raises(error, match=message):
        fill(
            source(Broken(killed)), range(6), lambda index, *_: kept.append(index), device="cpu",
            workers=2,
        )  # fmt: skip
    assert kept == [0, 1] and not multiprocessing.active_children()


def test_an_error_that_is_no_refusal_says_its_kind():
    failed = cache_drawing._failed(OSError("two.png: input/output error"))
    assert (failed.why, failed.refused) == ("OSError: two.png: input/output error", False)


def test_what_keep_raises_ends_all_and_is_raised():
    def keep(index, *_) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fill(source(), range(9), keep, device="cpu", workers=1)
    assert not multiprocessing.active_children()


def test_it_stops_in_time_without_a_gap(monkeypatch):
    kept = []
    clock = SimpleNamespace(monotonic=lambda: len(kept))
    monkeypatch.setattr(cache_drawing, "time", clock)
    report = fill(
        source(), range(5, 10_000), lambda index, *_: kept.append(index), device="cpu", workers=2,
        until=3,
    )  # fmt: skip
    assert kept == [5, 6, 7] and report.clips == 3
    shares = dict(report.stages)
    assert 0 < shares.pop("drawing") < 1 and sum(shares.values()) == pytest.approx(1)
    assert set(shares) == {"waiting", "simulating", "device", "keeping"}
    assert str(report).startswith("3 clips in ") and f"{report.clips_per_second:.1f}" in str(report)


def test_nothing_to_do_and_no_one_to_do_it():
    assert made(source(), [])[1].clips == 0
    with pytest.raises(ValueError, match="workers must be a whole number >= 1, got 0"):
        made(source(), range(3), workers=0)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_stopped_from_outside_all_end(how, tmp_path):
    told = tmp_path / "pids"
    call = f"from tests.training import filling; filling.fill_for_ever({str(told)!r})"
    asking = subprocess.Popen(
        [sys.executable, "-c", call], start_new_session=True, stderr=subprocess.DEVNULL
    )
    until(lambda: told.exists() and told.read_text().endswith("."))
    drawing = [int(pid) for pid in told.read_text()[:-1].split()]
    assert len(drawing) == 2 and all(map(runs, drawing))
    if how == signal.SIGINT:
        os.killpg(asking.pid, how)  # Ctrl-C reaches all of them
    else:
        asking.terminate()
    assert asking.wait(600) != 0
    until(lambda: not any(map(runs, drawing)))
