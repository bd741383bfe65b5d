"""Filling the pre-simulated turbulence caches of a lease: as many clips as time and memory hold."""

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack

from scripts.lease.plan import Fill
from scripts.lease.probe import GIB, MEMORY_FACTOR, UNUSED_GIB, Device, Trial, free_memory
from src.training.clip_cache import CachedClip, DeviceClipCache
from src.training.parallel_fill import FillReport, SimulatedClips, store_clips

MAX_WORKERS = 15
ENDLESS = range(2**31)  # numbers of clips


def fill_caches(
    caches: Sequence[DeviceClipCache], plan: Fill, device: Device, trial: Trial, log: Callable
) -> list[dict[str, float]]:
    """Fill `caches`, each with its share of `plan.minutes` and of the memory that a training as in
    `trial` leaves; samples are then of the clips that are there.  Returns clips and clips a second
    of each.

    Raises ValueError where the memory holds no clip of one.
    """
    free = free_memory(device.kind)
    room = free - MEMORY_FACTOR * trial.memory - UNUSED_GIB * GIB if trial.memory else free / 2
    sizes, reports = [cache.clips * cache.clip_bytes for cache in caches], []
    for cache, size in zip(caches, sizes, strict=True):
        share = size / sum(sizes)
        most = min(cache.clips, int(share * room) // cache.clip_bytes)
        if most < 1:
            clip = f"{cache.clip_bytes / 2**20:.1f} MiB"
            raise ValueError(f"fill: a clip of {clip} does not fit {free / GIB:.1f} GiB")
        if most < cache.clips:
            log(f"the memory holds {most} of {cache.clips} clips")
        cache.clips = most
        reports.append(_fill_cache(cache, plan, device.kind, 60 * share * plan.minutes, log))
    return reports


def _fill_cache(
    cache: DeviceClipCache, plan: Fill, device: str, seconds: float, log: Callable
) -> dict[str, float]:
    """Fill `cache` for `seconds`, with one clip at least; those who draw go on to renew it while it
    is trained on.

    Where the processes that draw died before the first clip, this one draws for `seconds`, and
    nothing is renewed.
    """
    most = max(1, min(MAX_WORKERS, (os.cpu_count() or 1) - 1))
    workers = most if plan.workers is None else plan.workers

    def fill_with(workers: int) -> FillReport:
        clips = SimulatedClips(cache.source, ENDLESS, device=device, workers=workers)
        until = time.monotonic() + seconds
        with ExitStack() as at_end:
            at_end.callback(clips.close)
            report = store_clips(clips, cache.store, count=cache.clips, until=until)
            if workers and report.clips and plan.renews:
                cache.renew_from(_renewing(clips, log))
                at_end.pop_all()
        return report

    report = FillReport(clips=0, seconds=0.0, waiting_s=0.0)
    try:
        report = fill_with(workers)
    except RuntimeError as error:
        if not workers:
            raise
        log(f"cache: {error}")
    if workers and not report.clips:
        log(f"cache: no clip by {workers} processes in {seconds:.0f} s; this one draws now")
        report = fill_with(0)
    cache.clips = report.clips
    few = f"; less than fill: warn_below_clips = {plan.warn_below_clips}"
    log(f"cache: {report}{few * (report.clips < plan.warn_below_clips)}")
    return {"clips": report.clips, "clips_per_second": report.clips_per_second}


def _renewing(clips: SimulatedClips, log: Callable) -> Generator[CachedClip]:
    """Yield `clips` until one fails, which is reported; a training goes on without new ones."""
    renewed = 0
    try:
        for renewed, (_, clip) in enumerate(clips, 1):  # noqa: B007
            yield clip
    except (RuntimeError, ValueError) as error:
        log(f"cache: renewed no more: {error}")
    finally:
        clips.close()
        log(f"cache: {renewed} clips renewed, {clips.waiting_s:.1f} s in all waiting for draws")
