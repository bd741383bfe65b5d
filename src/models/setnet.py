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
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from src.models.background import REVEALING_EVENTS, blend_background
from src.models.cell_clock import TRACE_TAU_S, ClockTick, run_clock
from src.models.context_pyramid import ContextPyramid, smooth_context
from src.models.layers import EqualDCConv, pad_centred_to_multiple, scan_windows
from src.models.network import (
    EventToVideoNetwork,
    check_voxel_shape,
    check_window_length,
    refuse_frame_with_state,
)
from src.models.setnet_state import Context, SetNetState
from src.models.time_gated_memory import TimeGatedMemory
from src.models.view_kernels import ViewKernels
from src.sim.optics import REACH, Position, check_positions, layout

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
CELL_PX = 2  # a cell: CELL_PX x CELL_PX pixels, one place of the half-resolution maps
CELL_BORDER = 2  # padding, in cells, of the decoder's two 3 x 3 convolutions together
REFERENCE_HZ = 120.0  # window rate in training; unit of time of rates and gates: 1 / REFERENCE_HZ
SUM_TAUS_S = (0.05, 0.5)  # time constants of the leaky sums

Maps = Float[Tensor, "m c h2 w2"]


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

        Raises ValueError for another shape, bins, a number of views, a window length (unless in a
        tensor on a GPU, which would be synchronised) or a state that do not fit.
        """
        check_voxel_shape(voxels)
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
        if not (n and windows):
            wanted = "one clip and one window or more"
            raise ValueError(f"voxels must hold {wanted}, got {tuple(voxels.shape)}")
        where = self.checked_positions(views, bins, positions)
        seconds = _durations(window_s, voxels)
        padded, (top, left) = pad_centred_to_multiple(voxels.flatten(0, 2), 8)
        voxels = padded.unflatten(0, (n, windows, views)).transpose(0, 1).float()
        counts = _sum_cells(voxels.abs().sum(3).flatten(0, 1))
        before = self._checked_state(state, counts[:n])

        tick, after = run_clock(counts, seconds, before)
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
            index = _to_device(output_windows, features.device)
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

    def is_settled(self, state: SetNetState | None) -> bool:
        """Return whether no clock advances, and so no frame changes, until there are events."""
        return state is not None and not state.activity.any()

    def advance_without_events(self, state: SetNetState, seconds: float) -> SetNetState:
        """Return the state, one that `is_settled`, after `seconds` without events: traces decay."""
        return state._replace(event_trace=state.event_trace * math.exp(-seconds / TRACE_TAU_S))

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
            allowed = f"in 1..{MAX_VIEWS} (in commands: optics.views)"
            raise ValueError(f"views must be {allowed}, got {views}")
        positions = layout(views) if positions is None else positions
        check_positions(positions, views)
        whole = tuple((int(row), int(column)) for row, column in positions)
        is_near = all(max(abs(row), abs(column)) <= REACH for row, column in whole)
        if not is_near or len(set(whole)) < views or whole != tuple(map(tuple, positions)):
            wanted = f"different whole (row, col) in -{REACH}..{REACH}"
            keys = "(in commands: optics.positions)"
            raise ValueError(f"positions must be {wanted} {keys}, got {positions}")
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
        refuse_frame_with_state(state)
        found, sizes = _sizes(state), _sizes(zeros)
        if found != sizes:
            raise ValueError(f"state must have sizes {sizes} for these voxels, got {found}")
        return SetNetState(*state)


def _sum_cells(x: Float[Tensor, "m views h w"]) -> Float[Tensor, "m views h2 w2"]:
    """Return the sums of 2 x 2 pixels; avg_pool2d is slower on a CPU."""
    rows = x[..., ::2, :] + x[..., 1::2, :]
    return rows[..., ::2] + rows[..., 1::2]


def _sizes(state: SetNetState) -> list:
    return [tuple(p.shape) if isinstance(p, Tensor) else [tuple(q.shape) for q in p] for p in state]


def _durations(window_s: float | Tensor, voxels: Tensor) -> Float[Tensor, "_n 1 1 1"]:
    """Return the length of the window, in seconds, one for each clip or for all."""
    check_window_length(window_s)
    if isinstance(window_s, Tensor):
        return window_s.to(voxels.device).float().view(-1, 1, 1, 1)
    return torch.full((1, 1, 1, 1), window_s, dtype=torch.float32, device=voxels.device)


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


def _to_device(numbers: Sequence[int | Position], device: torch.device) -> Int[Tensor, "..."]:
    """Return integers as a tensor."""
    kept = [_keep_on_device(number, device) for number in numbers]
    return torch.stack(kept) if kept else torch.empty(0, dtype=torch.long, device=device)


@cache
@torch.inference_mode(False)
def _keep_on_device(number: int | Position, device: torch.device) -> Int[Tensor, "..."]:
    """Return one window's number or one position as a tensor; made once and never freed: a CUDA
    graph cannot capture the copy from the host, and every replay reads the captured tensor.
    """
    return torch.tensor(number, dtype=torch.long, device=device)
