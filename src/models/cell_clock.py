"""SetNet's clock of each cell: it runs near supported events, and where the camera moves.

Also due by it: the updates of the context.  m: windows * n in order of time.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.models.background import REVEALING_EVENTS, REVEALING_S
from src.models.layers import scan_windows
from src.models.setnet_state import SetNetState

ACTIVITY_TAU_S = 0.005  # decay of the activity after the last event
TRACE_TAU_S = 0.01  # decay of the event trace
MIN_ACTIVITY = 0.25  # below which a cell stands still
MIN_SUPPORT = 1.5  # trace of a view in the 8 cells around an event, above which it is supported
REACH_CELLS = 3  # from a supported event, to which cells are active
STATIC_SHARE = 0.35  # of active cells, up to which the others stand still: a static camera
MOVING_SHARE = 0.5  # from which on the clock of all cells advances: a moving camera
CONTEXT_INTERVAL_S = 1 / 30  # shortest time between two context updates
UPDATE_RECENCY = math.exp(-0.98)  # an update is due at or below it: 0.98 intervals, for rounding
SETTLING = math.exp(-2)  # context recency above which the context of a cell is still smoothed


class ClockTick(NamedTuple):
    """Clock of all windows (m = windows * n)."""

    evidence: Float[Tensor, "m 1 h2 w2"]  # see SetNetState
    elapsed_s: Float[Tensor, "m 1 h2 w2"]  # time by which the state of a cell advances
    is_updated: Tensor  # (m, 1, h2, w2) bool: the context of the cell is updated
    context_recency: Float[Tensor, "m 1 h4 w4"]  # at the end of the window, before its update
    smoothing_s: Float[Tensor, "m 1 h4 w4"]  # time by which the smoothed context advances


@torch.no_grad()
def run_clock(
    counts: Float[Tensor, "m views h2 w2"], seconds: Tensor, state: SetNetState
) -> tuple[ClockTick, SetNetState]:
    """Return the ticks of all windows, and the state with the clock's fields after the last.

    A context update is due if the clock advances anywhere and the last is CONTEXT_INTERVAL_S
    old or missing; it reaches the cells that were active since the one before.
    """
    kept = torch.exp(-seconds / TRACE_TAU_S)
    traces, trace = scan_windows(lambda old, new: kept * old + new, state.event_trace, counts)
    supported = find_supported_events(counts, traces)
    near, gain = active_cell_mask(supported), spread_evidence(supported)
    activity, evidence, pending = state.activity, state.evidence, state.is_pending
    recency, cell_recency, ticks = state.update_recency, state.context_recency, []
    n = len(activity)
    for is_near, more in zip(near.split(n), gain.split(n), strict=True):
        elapsed_s, activity = advance_cell_clocks(is_near, seconds, activity)
        longest_s = elapsed_s.amax((2, 3), keepdim=True)
        moving_s = moving_camera_pace(activity) * longest_s
        elapsed_s = torch.maximum(elapsed_s, moving_s)
        evidence = evidence + more + REVEALING_EVENTS / REVEALING_S * moving_s
        kept_recency = torch.exp(-longest_s / CONTEXT_INTERVAL_S)
        recency, cell_recency = recency * kept_recency, cell_recency * kept_recency
        pending = torch.maximum(pending, (elapsed_s > 0).float())
        due = (recency <= UPDATE_RECENCY) & (longest_s > 0)
        is_updated = due & (pending > 0)
        coarse = functional.max_pool2d(pending, 2)
        smoothing_s = longest_s * ((coarse > 0) | (cell_recency > SETTLING))
        ticks.append(ClockTick(evidence, elapsed_s, is_updated, cell_recency, smoothing_s))
        cell_recency = torch.where(due & (coarse > 0), 1.0, cell_recency)
        recency, pending = torch.where(due, 1.0, recency), torch.where(due, 0.0, pending)
    tick = ClockTick(*map(torch.cat, zip(*ticks, strict=True)))
    return tick, state._replace(
        event_trace=trace, activity=activity, evidence=evidence, is_pending=pending,
        update_recency=recency, context_recency=cell_recency,
    )  # fmt: skip


def advance_cell_clocks(
    is_near_events: Tensor, window_s: Tensor, activity: Float[Tensor, "n 1 h2 w2"]
) -> tuple[Float[Tensor, "n 1 h2 w2"], Float[Tensor, "n 1 h2 w2"]]:
    """Return by how many seconds the clock of each cell advances in a window, and its activity.

    Near events it advances by `window_s` and activity is 1; elsewhere activity decays until it is
    MIN_ACTIVITY, then is 0, and the clock advances by its integral, however windows are cut.
    """
    remaining = activity * torch.exp(-window_s / ACTIVITY_TAU_S)
    fading_s = ACTIVITY_TAU_S * (activity - remaining.clamp(min=MIN_ACTIVITY)).clamp(min=0)
    remaining = torch.where(remaining < MIN_ACTIVITY, 0.0, remaining)
    elapsed_s = torch.where(is_near_events, window_s, fading_s)
    return elapsed_s, torch.where(is_near_events, 1.0, remaining)


def moving_camera_pace(activity: Float[Tensor, "n 1 h2 w2"]) -> Float[Tensor, "n 1 1 1"]:
    """Return the speed of all clocks relative to that of the most active cell: 0 up to STATIC_SHARE
    of active cells, 1 from MOVING_SHARE on."""
    share = (activity > 0).sum((2, 3), keepdim=True).float() / activity[0].numel()
    return ((share - STATIC_SHARE) / (MOVING_SHARE - STATIC_SHARE)).clamp(0, 1)


def find_supported_events(
    counts: Float[Tensor, "m views h2 w2"], trace: Float[Tensor, "m views h2 w2"]
) -> Float[Tensor, "m 1 h2 w2"]:
    """Return the supported events of each cell (sum of |voxels|), of the view that has most."""
    support = 9 * functional.avg_pool2d(trace, 3, 1, 1) - trace
    return (counts * (support > MIN_SUPPORT)).amax(1, keepdim=True)


def active_cell_mask(supported: Float[Tensor, "m 1 h2 w2"]) -> Tensor:
    """Return (m, 1, h2, w2) bool: cells within REACH_CELLS of a supported event of any view."""
    size = 2 * REACH_CELLS + 1
    return functional.max_pool2d((supported > 0).float(), size, 1, REACH_CELLS) > 0


def spread_evidence(supported: Float[Tensor, "m 1 h2 w2"]) -> Float[Tensor, "m 1 h2 w2"]:
    """Return supported events smoothed over REACH_CELLS on each side."""
    spread = supported
    for _ in range(REACH_CELLS):  # each with its own padding: ONNX Runtime takes no larger one
        spread = functional.avg_pool2d(functional.pad(spread, [2] * 4), 3, 1)
    return spread[..., REACH_CELLS:-REACH_CELLS, REACH_CELLS:-REACH_CELLS]
