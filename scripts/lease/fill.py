"""Filling the pre-simulated turbulence caches of a lease: as many clips as time and memory hold."""

import os
import time
from collections.abc import Callable, Sequence

from scripts.lease.fit import Sized
from scripts.lease.plan import Fill
from scripts.lease.probe import EMPTY_GIB, GIB, ROOM, Device, Trial, free_memory
from src.training.cache_fill import fill
from src.training.device_cache import DeviceCache

CORES = 15  # processes that draw scenes, at most


def check_memory(networks: Sequence[Sized], least: int, found: Device) -> None:
    """Raise ValueError where the memory of the device does not even hold `least` clips."""
    for one in networks:
        size = least * sum(cache.bytes for cache in one.caches[:1])
        if size > found.memory:
            raise ValueError(
                f"fill: least must be smaller: {least} clips for {one.name} take "
                f"{size / GIB:.1f} GiB, {found.name} has {found.memory / GIB:.1f}"
            )


def fill_all(
    caches: Sequence[DeviceCache], wanted: Fill, found: Device, trial: Trial, say: Callable
) -> list[dict]:
    """Fill `caches`, each with its share of `wanted.minutes` and of the memory that a training as
    in `trial` leaves; samples are then of the clips that are there.  Returns clips and clips a
    second of each.

    Raises ValueError where one stays empty.
    """
    room = free = free_memory(found.kind)
    room -= ROOM * trial.memory + EMPTY_GIB * GIB
    room = room if trial.memory else free / 2
    sizes, facts = [cache.clips * cache.bytes for cache in caches], []
    for cache, size in zip(caches, sizes, strict=True):
        share = size / sum(sizes)
        most = min(cache.clips, int(share * room) // cache.bytes)
        if most < 1:
            clip = f"{cache.bytes / 2**20:.1f} MiB"
            raise ValueError(f"fill: a clip of {clip} does not fit {free / GIB:.1f} GiB")
        if most < cache.clips:
            say(f"the memory holds {most} of {cache.clips} clips")
        cache.limit(most)
        until = time.monotonic() + 60 * share * wanted.minutes
        facts.append(_fill_one(cache, wanted, found.kind, until, say))
    return facts


def _fill_one(
    cache: DeviceCache, wanted: Fill, device: str, until: float, say: Callable
) -> dict[str, float]:
    workers = wanted.workers
    if workers is None:
        workers = max(1, min(CORES, (os.cpu_count() or 1) - 1))
    clips, start = 0, time.monotonic()
    if workers:
        every = range(cache.clips)
        report = fill(cache.source, every, cache.keep, device=device, workers=workers, until=until)
        clips = report.clips
        say(f"cache: {report}")
    else:
        while clips < cache.clips and time.monotonic() < until:
            cache.clip(clips)
            clips += 1
    if not clips:
        raise ValueError(f"fill: minutes must be > {wanted.minutes:g}: no clip was made")
    cache.limit(clips)
    speed = clips / (time.monotonic() - start)
    few = "" if clips >= wanted.least else f", less than fill: least = {wanted.least}"
    say(f"cache: {clips} clips, {speed:.1f} a second{few}")
    return {"clips": clips, "clips_per_second": speed}
