"""SetNet: video from the events of a set of 1 to 25 views, at any window length.

One window of events and the state in, one frame and the new state out.  Voxels: sums of polarity in
`bins` slices of the window, views registered to the centre view; frame: code values in [0, 1].
n: clips, m: windows * n in order of time, c: `channels` (16, 40 or 64), hk and wk: height and
width, padded by reflection to a multiple of 8, divided by k.  Right column: fields of SetNetState.

    voxels (n, views, bins, h, w)
      |
      +-> clock of each cell: trace of the events, support  (n, views, h2, w2)     event_trace
      |     speed, elapsed time, 0: the cell stands still   (n, 1, h2, w2)         activity
      |     supported events nearby so far                  (n, 1, h2, w2)         evidence
      |
    voxels of cells whose clock advances, of others 0
      |            |
      |          sum over bins and 2 x 2 pixels             (n, views, h2, w2)
      |          leaky sums, tau 0.05 s and 0.5 s           (n, views, 2, h2, w2)  view_sums
      |            |            |
      |            |          mean absolute deviation
      |            |          from the mean of the views    (n, 2, h2, w2)
      |            |            |
    5 x 5, /2    3 x 3        3 x 3     convolutions, each to (n, c, h2, w2)
    per 1/120 s    |            |
      +--- sum ----+------------+
            | ReLU                                          (n, c, h2, w2)
    time-gated memory: input 3 x 3, state 1 x 1             (n, c, h2, w2)         hidden
            |
            +-----------------+
            |          context pyramid: /4, /8, /16 and back, at most every 1/30 s  scales
            |          moving average                       (n, c, h4, w4)         context_average
            |          low-pass, tau 1/60 s                 (n, c, h4, w4)         context_smoothed
            |                 |
            + sum <- nearest -+                             (n, c, h2, w2)
            | ReLU, 3 x 3, ReLU, 3 x 3 with equal DC response, sigmoid
            |                                               (n, 4, h2, w2)
            | blended with the background by the evidence
            | pixel shuffle, crop
    frame (n, 1, h, w)

* Set of views: the views are stacked as channels of one convolution, and the kernel of each is a
  function of its position and of the number of views: one set of weights serves any arrangement.
  Their spread (mean absolute deviation) separates turbulence, different in each view, from the
  scene, common to all.
* Leaky sums: the polarities of a pixel sum to its change of log intensity, in thresholds; the leak
  bounds the accumulated error.
* Window length: memory, sums, trace and activity decay exponentially in time, not per window, and
  voxel counts become rates.  A supported event advances a cell by its whole window.
* Clock: a cell's runs near supported events (others fell in the 8 cells around, of the same view),
  and by at most 3.75 ms in all after the last; then its memory and sums are held, its context after
  a last update.  Memory and sums age by that clock, the context by the fastest one.  Where much of
  the picture is active the camera moves, and all clocks run.
* Background: what no event has revealed yet has one brightness, the mean at the rim of what is,
  begun at 0.45.
* Context: events lie at edges, so the brightness of a uniform area follows from edges that may be
  far; the pyramid provides the receptive field.  The context is updated at most 30 times a second
  and low-pass filtered, so that the frame does not change in steps.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn
from torch.nn import functional

from src.models.layers import (
    EqualDCConv,
    PreActivationBlock,
    init_kaiming,
    init_zero,
    pad_centred_to_multiple,
    require_bias,
)
from src.models.network import EventToVideoNetwork
from src.models.time_gated_update import TimeGatedUpdate, time_gated_update
from src.sim.optics import REACH, Position, layout

SIZES: dict[str, dict[str, Any]] = {  # GMAC at 176 x 176, 9 views, context included: 0.34, 1.2, 3.5
    "small": {"channels": 16, "context_channels": [32, 64, 96]},
    "medium": {
        "channels": 40, "context_channels": [56, 96, 128], "refine_fusion": True, "gate_rank": 32,
    },
    "large": {
        "channels": 64, "context_channels": [128, 192, 256], "refine_fusion": True, "gate_rank": 32,
    },
}  # fmt: skip
MAX_VIEWS = 25
KERNEL_RANKS = 5  # basis kernels that the position of a view weighs, beside one of all views
CELL_PX = 2  # a cell: CELL_PX x CELL_PX pixels, one place of the half-resolution maps
CELL_BORDER = 2  # padding, in cells, of the decoder's two 3 x 3 convolutions together
REFERENCE_HZ = 120.0  # window rate in training; unit of time of rates and gates: 1 / REFERENCE_HZ
SUM_TAUS_S = (0.05, 0.5)  # time constants of the leaky sums
ACTIVITY_TAU_S = 0.005  # decay of the activity after the last event
TRACE_TAU_S = 0.01  # decay of the event trace
MIN_ACTIVITY = 0.25  # below which a cell stands still
MIN_SUPPORT = 1.5  # trace of a view in the 8 cells around an event, above which it is supported
REACH_CELLS = 3  # from a supported event, to which cells are active
STATIC_SHARE = 0.35  # of active cells, up to which the others stand still: a static camera
MOVING_SHARE = 0.5  # from which on the clock of all cells advances: a moving camera
REVEALING_EVENTS = 0.05  # supported events per cell so far, at which a frame is half the background
REVEALING_S = 0.02  # the same in seconds of a moving camera
BACKGROUND = 0.45  # brightness of what no event has revealed, before anything is
BACKGROUND_WEIGHT = 1  # of BACKGROUND in the mean of blend_background
SETTLING = math.exp(-2)  # context recency above which the context of a cell is still smoothed
CONTEXT_INTERVAL_S = 1 / 30  # shortest time between two context updates
UPDATE_RECENCY = math.exp(-0.98)  # an update is due at or below it: 0.98 intervals, for rounding
CONTEXT_TAU_S = 1 / 60  # time constant of the low-pass on the context
INITIAL_CONTEXT_RATE = 0.9  # initial decay rate of the moving average, per CONTEXT_INTERVAL_S


Context = Float[Tensor, "n c h4 w4"]
Maps = Float[Tensor, "m c h2 w2"]


class SetNetState(NamedTuple):
    """What is carried from window to window, float32; zeros before the first."""

    view_sums: Float[Tensor, "n views taus h2 w2"]  # leaky polarity sums, per view and cell
    event_trace: Float[Tensor, "n views h2 w2"]  # events of a cell, decaying by TRACE_TAU_S
    activity: Float[Tensor, "n 1 h2 w2"]  # clock speed: 1 near supported events, decaying without
    evidence: Float[Tensor, "n 1 h2 w2"]  # supported events nearby so far, of the view with most
    is_pending: Float[Tensor, "n 1 h2 w2"]  # 1: was active since the last context update
    update_recency: Float[Tensor, "n 1 1 1"]  # exp(-age / CONTEXT_INTERVAL_S) of the last update
    context_recency: Float[Tensor, "n 1 h4 w4"]  # the same of each cell's own; 0: no context yet
    hidden: Float[Tensor, "n c h2 w2"]  # memory, in [-1, 1]
    scales: tuple[Tensor, ...]  # maps of the pyramid, those of ContextPyramid.held_map_sizes
    context_average: Context  # moving average of the pyramid's output
    context_smoothed: Context  # the same, low-pass filtered in time


class ClockTick(NamedTuple):
    """Clock of all windows (m = windows * n)."""

    evidence: Float[Tensor, "m 1 h2 w2"]  # see SetNetState
    elapsed_s: Float[Tensor, "m 1 h2 w2"]  # time by which the state of a cell advances
    is_updated: Tensor  # (m, 1, h2, w2) bool: the context of the cell is updated
    context_recency: Float[Tensor, "m 1 h4 w4"]  # at the end of the window, before its update
    smoothing_s: Float[Tensor, "m 1 h4 w4"]  # time by which the smoothed context advances


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


def blend_background(
    pixels: Float[Tensor, "m pixels h2 w2"], revealed: Float[Tensor, "m 1 h2 w2"]
) -> Float[Tensor, "m pixels h2 w2"]:
    """Return the pixels of each cell as far as it is `revealed`, in [0, 1], the rest of it with the
    mean brightness of cells that are so in part: r (1 - r) is their weight.
    """
    weight = revealed * (1 - revealed)
    light = (weight * pixels.mean(1, keepdim=True)).sum((2, 3), keepdim=True)
    total = weight.sum((2, 3), keepdim=True) + BACKGROUND_WEIGHT
    background = (light + BACKGROUND_WEIGHT * BACKGROUND) / total
    return background + revealed * (pixels - background)


class SetNet(EventToVideoNetwork):
    """The network of the module's diagram.

    `channels`: at half resolution; `context_channels`: at a quarter and each coarser scale;
    `refine_fusion`: see ContextPyramid; `gate_rank`: see TimeGatedMemory.  Views may come in
    any order, the same in all windows of a sequence.
    """

    uses_window_length = True

    def __init__(
        self,
        bins: int = 5,
        channels: int = 16,
        context_channels: Sequence[int] = (32, 64, 96),
        refine_fusion: bool = False,
        gate_rank: int | None = None,
    ):
        super().__init__()
        self.init_kwargs = {
            "bins": bins, "channels": channels, "context_channels": list(context_channels),
            "refine_fusion": refine_fusion, "gate_rank": gate_rank,
        }  # fmt: skip
        self.bins, self.channels, taus = bins, channels, len(SUM_TAUS_S)
        self.voxel_kernels = ViewKernels(bins, channels, 5)
        self.sum_kernels = ViewKernels(taus, channels, 3)
        self.spread_conv = nn.Conv2d(taus, channels, 3, padding=1, bias=False)
        self.memory: nn.Module = TimeGatedMemory(channels, gate_rank)
        self.context = ContextPyramid(channels, context_channels, refine_fusion)
        # Replicated: zero padding would imprint a 2 x 2 pixel pattern along the border.
        self.decoder_conv: nn.Module = nn.Conv2d(
            channels, channels, 3, padding=CELL_BORDER, padding_mode="replicate"
        )
        self.pixel_conv: nn.Module = EqualDCConv(channels, CELL_PX**2, 3)
        self.relu = nn.ReLU()
        # For inference: a cache of stem kernels by positions; None: recomputed in every call.
        self.cached_kernels: dict[tuple, tuple[Tensor, Tensor, Tensor]] | None = None

    @classmethod
    def preset(cls, size: str, bins: int = 5) -> "SetNet":
        """Return the network of a `size`: small, medium or large; ValueError for another."""
        if size not in SIZES:
            raise ValueError(f"model.size must be one of {', '.join(SIZES)}, got {size}")
        return cls(bins, **SIZES[size])

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: SetNetState | None = None,
        *,
        window_s: float | Tensor = 1 / REFERENCE_HZ,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], SetNetState]:
        """Return the frame at the end of the window, in [0, 1], float32, and the state.

        Raises ValueError for bins, a number of views, a window length or a state that do not fit.
        """
        window = voxels[:, None]
        frames, state = self.sequence(window, state, window_s=window_s, positions=positions)
        return frames[:, 0], state

    def sequence(
        self,
        voxels: Float[Tensor, "n windows views bins h w"],
        state: SetNetState | None = None,
        *,
        window_s: float | Tensor = 1 / REFERENCE_HZ,
        positions: Sequence[Position] | None = None,
        output_windows: Sequence[int] | None = None,
    ) -> tuple[Float[Tensor, "n outputs 1 h w"], SetNetState]:
        """Return the frames of `output_windows` (None: all) and the state after the last window.

        Only the recurrences run window by window; all other layers run once, with all windows in
        the batch (m = windows * n, in order of time), the decoder with `output_windows` only.
        """
        n, windows, views, bins, height, width = voxels.shape
        where = self.checked_positions(views, bins, positions)
        seconds = _durations(window_s, voxels)
        padded, (top, left) = pad_centred_to_multiple(voxels.flatten(0, 2), 8)
        voxels = padded.unflatten(0, (n, windows, views)).transpose(0, 1).float()
        counts = _sum_cells(voxels.abs().sum(3).flatten(0, 1))
        before = self._checked_state(state, counts[:n])

        tick, after = self.run_clock(counts, seconds, before)
        is_active = tick.elapsed_s > 0
        active_px = functional.interpolate(is_active.float(), scale_factor=CELL_PX, mode="nearest")
        voxels = voxels * active_px.unflatten(0, (windows, n))[:, :, None]
        cells = _sum_cells(voxels.sum(3).flatten(0, 1))
        decay = torch.stack([torch.exp(-tick.elapsed_s / tau) for tau in SUM_TAUS_S], 2)
        sums, view_sums = scan_windows(
            lambda sums, decay, new: decay * sums + new, before.view_sums, decay, cells[:, :, None]
        )
        stem = self.stem(voxels, sums, seconds, where)
        inputs = self.relu(stem) * is_active
        features, hidden = self.memory(inputs, before.hidden, REFERENCE_HZ * tick.elapsed_s)
        features = features.to(stem.dtype)
        new, scales = self.context(features, before.scales, tick.is_updated)
        contexts, context = self.average_context(new, before.context_average, tick)
        smoothed, context_smoothed = scan_windows(
            smooth_context, before.context_smoothed, contexts, tick.smoothing_s
        )
        evidence = tick.evidence
        if output_windows is not None:
            index = _to_device(tuple(output_windows), features.device)
            features, smoothed, evidence = (
                maps.unflatten(0, (-1, n)).index_select(0, index).flatten(0, 1)
                for maps in (features, smoothed, evidence)
            )
        revealed = evidence / (evidence + REVEALING_EVENTS)
        drawn = self.decode_logits(features, smoothed).sigmoid()
        frames = functional.pixel_shuffle(blend_background(drawn, revealed), CELL_PX)
        frames = frames[..., top : top + height, left : left + width]
        frames = frames.unflatten(0, (-1, n)).transpose(0, 1)
        return frames, after._replace(
            view_sums=view_sums, hidden=hidden, scales=scales, context_average=context,
            context_smoothed=context_smoothed,
        )  # fmt: skip

    @torch.no_grad()
    def run_clock(
        self, counts: Float[Tensor, "m views h2 w2"], seconds: Tensor, state: SetNetState
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

    def stem(
        self,
        voxels: Float[Tensor, "windows n views bins h w"],
        view_sums: Float[Tensor, "m views taus h2 w2"],
        seconds: Float[Tensor, "_n 1 1 1"],
        positions: tuple[Position, ...],
    ) -> Maps:
        """Return the sum of the three first convolutions, before the ReLU."""
        voxel_kernel, sum_kernel, bias = self.stem_kernels_and_bias(positions)
        spread = (view_sums - view_sums.mean(1, keepdim=True)).abs().mean(1)
        stacked = _as_conv_input(voxels.flatten(2, 3), voxel_kernel.dtype)
        counts = functional.conv2d(
            stacked, voxel_kernel, None, CELL_PX, voxel_kernel.shape[-1] // 2
        )
        sums = torch.cat([view_sums.flatten(1, 2), spread], 1)
        sums = _as_conv_input(sums[None], sum_kernel.dtype)
        scale = 1 / (REFERENCE_HZ * seconds)  # to counts per 1 / REFERENCE_HZ
        rates = counts * scale.repeat(len(counts) // len(scale), 1, 1, 1).to(counts.dtype)
        return rates + functional.conv2d(sums, sum_kernel, bias, 1, 1)

    def average_context(
        self, new: Float[Tensor, "m c h4 w4"], context: Tensor, tick: ClockTick
    ) -> tuple[Float[Tensor, "m c h4 w4"], Context]:
        """Return the moving average after each window and after the last, float32."""

        def step(before: Tensor, new: Tensor, recency: Tensor, updated: Tensor) -> Tensor:
            # `recency`: exp(-age / interval) of the context before
            average = torch.lerp(new, before, recency ** self.context.log_rate.float().exp())
            return torch.where(updated, average, before)

        updated = functional.max_pool2d(tick.is_updated.float(), 2) > 0
        return scan_windows(step, context, new.float(), tick.context_recency, updated)

    def decode_logits(
        self, features: Maps, context: Float[Tensor, "m c h4 w4"]
    ) -> Float[Tensor, "m pixels _h2 _w2"]:
        """Return the logits of the pixels of each cell, as channels, float32."""
        coarse = functional.interpolate(context.to(features.dtype), scale_factor=2, mode="nearest")
        x = self.relu(coarse + features)
        return self.pixel_conv(self.relu(self.decoder_conv(x))).float()

    def stem_kernels_and_bias(
        self, positions: tuple[Position, ...]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the kernels of stacked voxels (c, views * bins, 5, 5) and of stacked sums and
        their spread (c, views * taus + taus, 3, 3), for views at `positions`, and the bias (c,).
        """
        device = self.spread_conv.weight.device
        if self.cached_kernels is not None and (positions, device) in self.cached_kernels:
            return self.cached_kernels[positions, device]
        place = _to_device(positions, device).float()
        sums = torch.cat([self.sum_kernels.kernel(place), self.spread_conv.weight], 1)
        bias = self.voxel_kernels.bias + self.sum_kernels.bias
        kernels = self.voxel_kernels.kernel(place), sums, bias
        if self.cached_kernels is not None:
            sums = sums.contiguous(memory_format=torch.channels_last)
            self.cached_kernels[positions, device] = kernels = kernels[0], sums, bias
        return kernels

    def checked_positions(
        self, views: int, bins: int, positions: Sequence[Position] | None
    ) -> tuple[Position, ...]:
        """Return the positions of the views; ValueError for bins or views that do not fit."""
        if bins != self.bins:
            raise ValueError(f"bins must be {self.bins} for this network, got {bins}")
        if not 1 <= views <= MAX_VIEWS:
            raise ValueError(f"optics.views must be in 1..{MAX_VIEWS}, got {views}")
        positions = layout(views) if positions is None else positions
        if len(positions) != views:
            raise ValueError(f"optics.positions must be {views} (row, col), got {positions}")
        whole = tuple((int(row), int(column)) for row, column in positions)
        is_near = all(max(abs(row), abs(column)) <= REACH for row, column in whole)
        if not is_near or len(set(whole)) < views or whole != tuple(map(tuple, positions)):
            wanted = f"different whole (row, col) in -{REACH}..{REACH}"
            raise ValueError(f"optics.positions must be {wanted}, got {positions}")
        return whole

    def _checked_state(self, state: SetNetState | None, cells: Tensor) -> SetNetState:
        """Return `state`, or zeros of the right sizes; ValueError when they are not right."""
        n, views, rows, columns = cells.shape
        half, quarter = (rows, columns), (rows // 2, columns // 2)
        zeros = SetNetState(
            view_sums=cells.new_zeros(n, views, len(SUM_TAUS_S), *half),
            event_trace=cells.new_zeros(n, views, *half),
            activity=cells.new_zeros(n, 1, *half),
            evidence=cells.new_zeros(n, 1, *half),
            is_pending=cells.new_zeros(n, 1, *half),
            update_recency=cells.new_zeros(n, 1, 1, 1),
            context_recency=cells.new_zeros(n, 1, *quarter),
            hidden=cells.new_zeros(n, self.channels, *half),
            scales=tuple(cells.new_zeros(n, *size) for size in self.context.held_map_sizes(*half)),
            context_average=cells.new_zeros(n, self.channels, *quarter),
            context_smoothed=cells.new_zeros(n, self.channels, *quarter),
        )
        if state is None:
            return zeros
        found, sizes = _sizes(state), _sizes(zeros)
        if found != sizes:
            raise ValueError(f"state must have sizes {sizes} for these voxels, got {found}")
        return SetNetState(*state)


class ViewKernels(nn.Module):
    """Makes the kernel of a convolution over stacked views from the positions of the views.

    kernel(position) = (basis_0 + sum_r code_r(position, views) basis_r) / views, code an MLP: with
    as many ranks as views it can equal any convolution of the stacked views of one layout.
    """

    def __init__(self, inputs: int, outputs: int, kernel_size: int):
        super().__init__()
        shape = ((KERNEL_RANKS + 1) * outputs, inputs, kernel_size, kernel_size)
        bound = 1 / math.sqrt(inputs * kernel_size**2)
        self.basis = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.code = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, KERNEL_RANKS))

    def kernel(
        self, positions: Float[Tensor, "views 2"]
    ) -> Float[Tensor, "outputs viewsinputs size size"]:
        """Return the kernel for the stacked views at `positions` (row, col)."""
        code, basis = self.factors(positions)
        return torch.einsum("vr,roikl->ovikl", code, basis).flatten(1, 2)

    def factors(
        self, positions: Float[Tensor, "views 2"]
    ) -> tuple[Float[Tensor, "views basis"], Float[Tensor, "basis outputs inputs size size"]]:
        """Return the coefficients (1, code) / views of each view and the basis kernels."""
        views = len(positions)
        # Inputs of the MLP, of order 1: row, column, and 3 / views.
        known = torch.cat([positions, torch.full_like(positions[:, :1], 3 / views)], 1)
        code = self.code(known.to(self.bias.dtype))
        code = torch.cat([torch.ones_like(code[:, :1]), code], 1) / views
        return code, self.basis.unflatten(0, (code.shape[1], -1))


class TimeGatedMemory(nn.Module):
    """A recurrent cell with a gate and a candidate in continuous time (`time_gated_update`).

    s' = k s + (1 - k) tanh(candidate), k = exp(-t relu(gate)), t in units of 1 / REFERENCE_HZ: with
    t = 0 or gate <= 0 the state is held.  The input enters by 3 x 3, the state by 1 x 1
    convolutions, so that nothing spreads in space over time.  `gate_rank`: the 3 x 3 convolution is
    factored into 3 x 3 to so many channels and 1 x 1, which costs less (None: not factored).
    """

    def __init__(self, channels: int, gate_rank: int | None = None):
        super().__init__()
        inputs, size = (gate_rank, 1) if gate_rank else (channels, 3)
        self.input_features = (
            nn.Conv2d(channels, gate_rank, 3, padding=1, bias=False) if gate_rank else nn.Identity()
        )
        self.input_gates = nn.Conv2d(inputs, 2 * channels, size, padding=size // 2)
        self.state_gates = nn.Conv2d(channels, 2 * channels, 1, bias=False)
        with torch.no_grad():  # initial time constants of 1.4 to 20 windows of 1/120 s
            require_bias(self.input_gates)[:channels].copy_(torch.linspace(0.05, 0.7, channels))

    def forward(
        self, x: Maps, state: Float[Tensor, "n c h2 w2"], elapsed: Float[Tensor, "m 1 _h _w"]
    ) -> tuple[Maps, Float[Tensor, "n c h2 w2"]]:
        """Return the state, float32, after each of m = windows * n steps and after the last."""
        update = TimeGatedUpdate.apply if torch.is_grad_enabled() else time_gated_update

        def step(state: Tensor, from_input: Tensor, elapsed: Tensor) -> Tensor:
            return update(from_input + self.state_gates(state.to(x.dtype)), state, elapsed)

        return scan_windows(step, state, self.input_gates(self.input_features(x)), elapsed)


class ContextPyramid(nn.Module):
    """A feature pyramid: one stride-2 convolution and residual block for each of `widths`
    (channels), then the coarser scales are added to the finer ones, up to half the input's size.

    Residual sums have no ReLU after them (He et al. 2016, identity mappings) and the output starts
    at zero: otherwise a high learning rate leaves dead ReLUs.  `refine_fusion`: a
    residual block also after each sum of two scales.
    """

    def __init__(self, channels: int, widths: Sequence[int], refine_fusion: bool = False):
        super().__init__()
        pairs = list(pairwise([channels, *widths]))
        downs = [init_kaiming(nn.Conv2d(a, b, 3, 2, padding=1)) for a, b in pairs]
        self.down_blocks = nn.ModuleList(PreActivationBlock(width) for width in widths)
        ups = [init_kaiming(nn.Conv2d(b, a, 1)) for a, b in pairs]
        init_zero(ups[0])
        self.downs, self.ups = nn.ModuleList(downs), nn.ModuleList(ups)
        self.fusion_blocks = nn.ModuleList(
            PreActivationBlock(width) if refine_fusion else nn.Identity() for width in widths[:-1]
        )
        self.relu = nn.ReLU()
        initial = torch.full((channels, 1, 1), math.log(INITIAL_CONTEXT_RATE))
        self.log_rate = nn.Parameter(initial)  # log decay rate of the moving average, per channel

    def held_map_sizes(self, rows: int, columns: int) -> list[tuple[int, int, int]]:
        """Return the sizes (c, h, w) of the maps that are held: those of the scales, finest first,
        then the sums with the coarser ones but the finest, coarsest first."""
        sizes = []
        for down in self.downs:
            rows, columns = -(-rows // 2), -(-columns // 2)
            assert isinstance(down, nn.Conv2d)
            sizes.append((down.out_channels, rows, columns))
        return [*sizes, *reversed(sizes[1:-1])]

    def forward(
        self, x: Float[Tensor, "m c h2 w2"], held: tuple[Tensor, ...], is_updated: Tensor
    ) -> tuple[Float[Tensor, "m c h4 w4"], tuple[Tensor, ...]]:
        """Return a map of half the size of `x` (m = windows * n), and the held maps after the last
        window.  Each map changes only in cells over one that `is_updated` (m, 1, h2, w2).
        """
        due = None
        # Shapes that depend on data would synchronise a GPU, and no exported model has them.
        if not x.is_cuda and not torch.jit.is_tracing() and not torch.compiler.is_compiling():
            due = is_updated.flatten(1).any(1).nonzero().flatten()
        masks, mask = [], is_updated.float()
        for _ in self.downs:
            mask = functional.max_pool2d(mask, 2, ceil_mode=True)
            masks.append(mask > 0)
        remaining, after, scales = list(held), [], []
        for down, block, mask in zip(self.downs, self.down_blocks, masks, strict=True):
            new = _run_on(due, lambda x, d=down, b=block: b(d(x)), x)
            x, last = scan_windows(_hold, remaining.pop(0), new, mask)
            x = x.to(new.dtype)
            scales.append(x)
            after.append(last)
        scales.pop()
        for scale in reversed(range(len(scales))):
            new = _run_on(due, lambda x, f, k=scale: self.fuse(x, f, k), x, scales[scale])
            x = new
            if scale:
                x, last = scan_windows(_hold, remaining.pop(0), new, masks[scale])
                x = x.to(new.dtype)
                after.append(last)
        return _run_on(due, lambda x: self.ups[0](self.relu(x)), x), tuple(after)

    def fuse(self, x: Tensor, finer: Tensor, scale: int) -> Tensor:
        """Return the sum of a scale, `finer`, and `x` of the next coarser one, refined."""
        x = self.ups[scale + 1](self.relu(x))
        coarser = functional.interpolate(x, finer.shape[-2:], mode="bilinear")
        return self.fusion_blocks[scale](finer + coarser)


def scan_windows(
    step: Callable[..., Tensor], state: Float[Tensor, "n ..."], *maps: Shaped[Tensor, "m ..."]
) -> tuple[Float[Tensor, "m ..."], Float[Tensor, "n ..."]]:
    """Return the state after every window and after the last: state = step(state, *maps of the
    window), with `maps` of m = windows * n.
    """
    if len(maps[0]) == len(state):  # OpenVINO would copy what is split into one
        state = step(state, *maps)
        return state, state
    states = []
    for now in zip(*(part.split(len(state)) for part in maps), strict=True):
        state = step(state, *now)
        states.append(state)
    return torch.cat(states), state


def smooth_context(smoothed: Tensor, context: Tensor, elapsed_s: Tensor) -> Tensor:
    """Return `smoothed` after a first-order low-pass step of `elapsed_s` toward `context`."""
    return torch.lerp(context, smoothed, torch.exp(-elapsed_s / CONTEXT_TAU_S))


def _hold(before: Tensor, new: Tensor, is_updated: Tensor) -> Tensor:
    return torch.where(is_updated, new.float(), before)


def _run_on(due: Tensor | None, work: Callable[..., Tensor], *maps: Tensor) -> Tensor:
    """Return work(*maps) for the entries `due` (None: all) and zeros for the others."""
    if due is None:
        return work(*maps)
    some = work(*(part[due] for part in maps))
    return some.new_zeros(len(maps[0]), *some.shape[1:]).index_copy(0, due, some)


def _sum_cells(x: Float[Tensor, "m views h w"]) -> Float[Tensor, "m views h2 w2"]:
    """Return the sums of 2 x 2 pixels; avg_pool2d is slower on a CPU."""
    rows = x[..., ::2, :] + x[..., 1::2, :]
    return rows[..., ::2] + rows[..., 1::2]


def _sizes(state: SetNetState) -> list:
    return [tuple(p.shape) if isinstance(p, Tensor) else [tuple(q.shape) for q in p] for p in state]


def _durations(window_s: float | Tensor, voxels: Tensor) -> Float[Tensor, "_n 1 1 1"]:
    """Return the length of the window, in seconds, one for each clip or for all."""
    if isinstance(window_s, Tensor):
        return window_s.to(voxels.device).float().view(-1, 1, 1, 1)
    if not 0 < window_s < math.inf:
        raise ValueError(f"window_s must be > 0 seconds, got {window_s}")
    return torch.full((1, 1, 1, 1), window_s, device=voxels.device)


def _as_conv_input(
    x: Float[Tensor, "windows n c h w"], dtype: torch.dtype
) -> Float[Tensor, "m c h w"]:
    """Return the maps in the type of a convolution, that of autocast where it is on, channels last:
    in one copy.
    """
    kind = x.device.type
    dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else dtype
    if torch.jit.is_tracing():  # OpenVINO cannot express a copy into a view
        return x.flatten(0, 1).to(dtype)
    windows, n, c, h, w = x.shape
    maps = torch.empty(
        windows * n, c, h, w, dtype=dtype, device=x.device, memory_format=torch.channels_last
    )
    maps.unflatten(0, (windows, n)).copy_(x)
    return maps


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _to_device(numbers: tuple, device: torch.device) -> Int[Tensor, "..."]:
    """Return integers as a tensor; cached: a CUDA graph cannot capture the copy from the host."""
    return torch.tensor(numbers, dtype=torch.long, device=device)
