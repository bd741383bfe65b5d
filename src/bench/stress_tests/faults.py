"""Stress tests of a light field whose camera, clock or calibration fails."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

import numpy as np

from src.bench.candidates import Candidate
from src.bench.stress_tests.conditions import require_views
from src.bench.stress_tests.event_clips import (
    US_PER_S,
    Curve,
    EventClip,
    StressBench,
    compute_losses_against_best,
)
from src.bench.stress_tests.stress_results import StressResult, build_worst_psnr_loss_result
from src.metrics.video_metrics import score_aligned_psnr
from src.sim.optics import Position, layout, most_central_view_index

Fault = Callable[[EventClip], EventClip]
US_PER_MS = 1e3


def measure_silent_view_loss(
    network: Candidate, bench: StressBench, *, limit_db: float
) -> StressResult:
    """Return the aligned PSNR lost in the second half of a clip in which one view has no events,
    the worse of the centre view and one beside it.
    """
    silent = {"centre view": 0, "view beside it": 1}
    faults = {
        name: lambda clip, which=which: _change_view(
            network, clip, which, lambda events, half_us: events[events["t"] < half_us]
        )
        for name, which in silent.items()
    }
    curve = _second_half_losses(network, bench, faults)
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied="view without events")


def measure_clock_jump_loss(
    network: Candidate, bench: StressBench, *, limit_db: float, jumps_ms: Sequence[float]
) -> StressResult:
    """Return the aligned PSNR lost in the second half of a clip in which the clock of one view
    beside the centre is ahead by `jumps_ms`, the worst of them.
    """

    def jump(jump_ms: float) -> Fault:
        def late(events: np.ndarray, half_us: float) -> np.ndarray:
            moved = events.copy()
            moved["t"][events["t"] >= half_us] += round(jump_ms * US_PER_MS)
            return moved

        return lambda clip: _change_view(network, clip, 1, late)

    curve = _second_half_losses(network, bench, {ms: jump(ms) for ms in jumps_ms})
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied="ms of a view's clock")


def measure_view_order_loss(
    network: Candidate, bench: StressBench, *, limit_db: float
) -> StressResult:
    """Return the aligned PSNR lost, in the second half of a clip, where rows and columns of the
    views are exchanged.
    """

    def transpose(clip: EventClip) -> EventClip:
        events = dict(zip(clip.positions, clip.events, strict=True))
        if not all((column, row) in events for row, column in events):
            raise ValueError("the views are no square")
        return replace(clip, events=[events[column, row] for row, column in clip.positions])

    curve = _second_half_losses(network, bench, {"rows for columns": transpose})
    return build_worst_psnr_loss_result(curve, limit_db=limit_db, varied="order of views")


def _change_view(
    network: Candidate, clip: EventClip, which: int,
    change: Callable[[np.ndarray, float], np.ndarray],
) -> EventClip:  # fmt: skip
    """Return `clip` with `change(events, middle in microseconds)` of one view that the network is
    given: the centre view (0) or the one before it (1)."""
    own: Sequence[Position] = layout(network.views)
    changed = list(clip.positions).index(own[most_central_view_index(own) - which])
    half_us = clip.duration_s / 2 * US_PER_S
    events = list(clip.events)
    events[changed] = change(events[changed], half_us)
    return replace(clip, events=events)


def _second_half_losses(
    network: Candidate, bench: StressBench, faults: Mapping[Any, Fault]
) -> Curve:
    """Return (setting, dB lost in the second half of the standard clips) for each fault."""
    require_views(network, 2)

    def score(clip: EventClip) -> float:
        frames, half = clip.reconstruct(network)[0], len(clip.truth) // 2
        return float(score_aligned_psnr(frames[half:], clip.truth[half:]).mean())

    clips = bench.clips()
    base = fmean(map(score, clips))
    scores = [(name, fmean(score(fault(clip)) for clip in clips)) for name, fault in faults.items()]
    return compute_losses_against_best(base, scores)
