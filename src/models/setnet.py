"""SetNet, ours: frames from any number of views, at any rate, at a fraction of E2VID's cost.

All of it is here.  Views come in as a set: a view's kernel follows from its position, so the first
layer is a stack of views with weights made for whoever is there; the spread across views says where
they agree.  Leaky sums of events give the network a memory from its first step.  Time passes in
seconds, not in windows, and only where events come: every decay and every update is raised to the
power of the time that passed, so that one set of weights serves 120 and 12,000 windows a second,
and a picture without events stays.

half resolution: stem -> quarter: GRU -> eighth: GRU, residual block -> up, up -> pixel shuffle.
"""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from src.models.layers import ResidualBlock, pad_to_multiple
from src.sim.optics import layout

SIZES = {  # multiply-accumulates at 176 x 176 with nine views: 0.4, 0.8 and 3 G
    "small": {"stem": 12, "channels": 32},
    "medium": {"stem": 16, "channels": 48},
    "large": {"stem": 32, "channels": 96},
}
MEMORIES_S = (0.05, 0.5)  # time constants of the leaky sums
AWAKE_S = 0.005  # time constant by which a block falls asleep after its last event
RATE = 120.0  # windows a second at which an update gate is taken as it is
MAX_VIEWS = 25
CELL = 2  # pixels: side of what the first layer sees as one

Position = tuple[int, int]
State = tuple[Tensor, ...]


class SetNet(nn.Module):
    """Voxel grids of 1 to 25 views to frames in [0, 1], window by window.

    `stem`: channels at half resolution.  `channels`: at a quarter, doubled at an eighth.  The order
    of the views is free but the same in all windows of a sequence.
    """

    views = None
    sizes = SIZES
    local = True  # each block falls asleep by itself; False: all of a picture together
    direct = len(MEMORIES_S)  # of the mean view's leaky sums are drawn without any learning

    def __init__(self, bins: int = 5, stem: int = 12, channels: int = 32):
        super().__init__()
        self.arguments = {"bins": bins, "stem": stem, "channels": channels}  # that make it again
        self.bins = bins
        memories = len(MEMORIES_S)
        self.voxel_stem = ViewKernels(bins, stem, 5)
        self.sum_stem = ViewKernels(memories, stem, 3)
        self.spread_stem = nn.Conv2d(memories, stem, 3, padding=1, bias=False)
        self.down4 = nn.Conv2d(stem, channels, 3, 2, padding=1)
        self.cell4 = self.unit(channels)
        self.down8 = nn.Conv2d(channels, 2 * channels, 3, 2, padding=1)
        self.cell8 = self.unit(2 * channels)
        self.block8 = ResidualBlock(2 * channels)
        self.up4 = nn.Conv2d(2 * channels, channels, 1)
        self.mix4 = nn.Conv2d(channels, channels, 3, padding=1)
        self.up2 = nn.Conv2d(channels, stem, 1)
        self.mix2 = nn.Conv2d(stem, stem, 3, padding=1)
        self.shuffle = nn.Conv2d(stem, CELL**2, 3, padding=1)
        self.frozen: dict[tuple, tuple[Tensor, ...]] | None = None  # kernels kept, for running
        self.skip = nn.Parameter(torch.full((self.direct,), 0.15)) if self.direct else None

    def unit(self, channels: int) -> nn.Module:
        """Return a memory of so many channels."""
        return PacedGRU(channels)

    @classmethod
    def preset(cls, size: str, bins: int = 5) -> "SetNet":
        """Return the network of a `size`: small, medium or large; ValueError for another."""
        if size not in cls.sizes:
            raise ValueError(f"model.size must be one of {', '.join(cls.sizes)}, got {size}")
        return cls(bins, **cls.sizes[size])

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: State | None = None,
        *,
        window_s: float | Tensor = 1 / RATE,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], State]:
        """Return the frame at the end of the window, float32, and the state.

        `window_s`: how long the window lasts, in seconds, a number or one per clip (n,).
        `positions`: (row, col) of each view from the centre view; default: `optics.layout`.
        State, float32: leaky sums of the mean view and, in cells, of each view, how awake each
        block of 8 x 8 is, and the `hidden` maps, in [-1, 1].  Raises ValueError for bins, a number
        of views, a length of window or a state that do not fit.
        """
        frames, state = self.sequence(
            voxels[:, None], state, window_s=window_s, positions=positions
        )
        return frames[:, 0], state

    def sequence(
        self,
        voxels: Float[Tensor, "n windows views bins h w"],
        state: State | None = None,
        *,
        window_s: float | Tensor = 1 / RATE,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n windows 1 h w"], State]:
        """Return the frame of every window, as window by window, and the state after the last one.

        Layer by layer: only what is remembered goes window by window, all else sees all of them at
        once, in order of time (windows * n).
        """
        n, windows, views, bins, height, width = voxels.shape
        places = self.places(views, bins, positions)
        seconds = _seconds(window_s, voxels)
        padded, (top, left) = pad_to_multiple(voxels.flatten(0, 2), 8)
        voxels = padded.unflatten(0, (n, windows, views)).transpose(0, 1)
        events = voxels.float().sum(3).flatten(0, 1)
        coarse = _halved(events)
        mean_sums, sums, awake, *hidden = self._start(state, coarse[:n])

        awake, passed = _time(_stirred(coarse, self.local), awake, seconds)
        keep = torch.cat([torch.exp(-passed / memory) for memory in MEMORIES_S], 1)
        kept = grown(keep, 8 // CELL)[:, None]
        all_sums, sums = over_time(_leaked, sums, kept, coarse[:, :, None])
        spread = (all_sums - all_sums.mean(1, keepdim=True)).abs().mean(1)

        grids, memories, bias = self.kernels(places)
        stacked = _cast(voxels, grids.dtype).reshape(windows * n, views * bins, *voxels.shape[-2:])
        stem = functional.conv2d(stacked, grids, None, CELL, grids.shape[-1] // 2)
        memory = torch.cat([all_sums.flatten(1, 2), spread], 1).to(memories.dtype)
        stem = stem + functional.conv2d(memory, memories, bias, 1, 1)
        x, *hidden = self.after_stem(stem, passed, *hidden)
        x = functional.pixel_shuffle(x, CELL)
        if self.direct:
            mean = events.mean(1, keepdim=True)
            every, mean_sums = over_time(_leaked, mean_sums, grown(keep, 8), mean)
            x = x + (self.skip[:, None, None] * every).sum(1, keepdim=True)
        frames = x.sigmoid()[..., top : top + height, left : left + width].float()
        state = (mean_sums, sums, awake, *hidden)
        return frames.unflatten(0, (windows, n)).transpose(0, 1), state

    def after_stem(
        self, stem: Tensor, passed: Tensor, hidden4: Tensor, hidden8: Tensor
    ) -> tuple[Float[Tensor, "n pixels hc wc"], Tensor, Tensor]:
        """Return what is drawn, the pixels of a cell as channels, float32, and the new hidden maps.

        `stem`: before its ReLU, (windows * n, stem, hc, wc); `passed`: seconds, (windows * n, 1,
        h8, w8); what is drawn has every window too, the hidden maps are those after the last.
        """
        return self.below(stem.relu(), passed, hidden4, hidden8)

    def below(
        self, seen: Tensor, passed: Tensor, hidden4: Tensor, hidden8: Tensor
    ) -> tuple[Float[Tensor, "n pixels hc wc"], Tensor, Tensor]:
        """Return what `after_stem` does; `seen`: what is known at half resolution."""
        pace = RATE * passed
        all4, hidden4 = self.cell4(self.down4(seen).relu(), hidden4, grown(pace, 2))
        after4 = all4.to(seen.dtype)
        all8, hidden8 = self.cell8(self.down8(after4).relu(), hidden8, pace)
        x = self.block8(all8.to(seen.dtype))
        x = self.mix4((grown(self.up4(x), 2) + after4).relu()).relu()
        x = self.mix2((grown(self.up2(x), 2) + seen).relu()).relu()
        return self.shuffle(x).float(), hidden4, hidden8

    def kernels(self, places: tuple[Position, ...]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the kernels of the stem for views that stand at `places`: of the stacked grids
        (stem, views * bins, 5, 5), of the stacked sums and their spread, and the bias.
        """
        device = self.shuffle.bias.device
        if self.frozen is not None and (places, device) in self.frozen:
            return self.frozen[places, device]
        stood = torch.tensor(places, device=device).float()
        memories = torch.cat([self.sum_stem.kernel(stood), self.spread_stem.weight], 1)
        bias = self.voxel_stem.bias + self.sum_stem.bias
        kernels = self.voxel_stem.kernel(stood), memories, bias
        if self.frozen is not None:
            memories = memories.contiguous(memory_format=torch.channels_last)
            self.frozen[places, device] = kernels = kernels[0], memories, bias
        return kernels

    def places(
        self, views: int, bins: int, positions: Sequence[Position] | None
    ) -> tuple[Position, ...]:
        if bins != self.bins:
            raise ValueError(f"bins must be {self.bins} for this network, got {bins}")
        if not 1 <= views <= MAX_VIEWS:
            raise ValueError(f"optics.views must be in 1..{MAX_VIEWS}, got {views}")
        positions = layout(views) if positions is None else positions
        if len(positions) != views:
            raise ValueError(f"optics.positions must be {views} (row, col), got {positions}")
        return tuple((int(row), int(column)) for row, column in positions)

    def hidden(self, height: int, width: int) -> list[tuple[int, int, int]]:
        """Return the sizes (c, h, w) of the hidden maps of a picture."""
        quarter, eighth = self.up4.out_channels, self.up4.in_channels
        return [(quarter, height // 4, width // 4), (eighth, height // 8, width // 8)]

    def _start(self, state: State | None, coarse: Tensor) -> State:
        """Return `state`, or zeros of the right sizes; ValueError when they are not right."""
        n, views, rows, columns = coarse.shape
        height, width = CELL * rows, CELL * columns
        sizes = [
            (n, self.direct, height, width),
            (n, views, len(MEMORIES_S), rows, columns),
            (n, 1, height // 8, width // 8),
            *((n, *size) for size in self.hidden(height, width)),
        ]
        if state is None:
            return tuple(coarse.new_zeros(size) for size in sizes)
        found = [tuple(part.shape) for part in state]
        if found != sizes:
            raise ValueError(f"state must have sizes {sizes} for these voxels, got {found}")
        return state


class ViewKernels(nn.Module):
    """The kernels of a convolution over a set of views, averaged; one follows from where it stands.

    kernel(place) = shared + sum over ranks of code(place) * kernels: with as many ranks as views
    it is an ordinary convolution of stacked views.
    """

    def __init__(self, inputs: int, outputs: int, kernel_size: int, ranks: int = 5):
        super().__init__()
        shape = ((ranks + 1) * outputs, inputs, kernel_size, kernel_size)
        bound = 1 / math.sqrt(inputs * kernel_size**2)
        self.kernels = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.code = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, ranks))

    def kernel(
        self, places: Float[Tensor, "views 2"]
    ) -> Float[Tensor, "outputs viewsinputs size size"]:
        """Return the kernel for the stacked views that stand at `places` (row, col)."""
        views = len(places)
        # Positions and the number of views, in units that keep the codes apart.
        known = torch.cat([places, torch.full_like(places[:, :1], 3 / views)], 1)
        code = self.code(known.to(self.bias.dtype))
        code = torch.cat([torch.ones_like(code[:, :1]), code], 1) / views
        kernels = self.kernels.unflatten(0, (code.shape[1], -1))
        return torch.einsum("vr,roikl->ovikl", code, kernels).flatten(1, 2)


class PacedGRU(nn.Module):
    """A ConvGRU (Ballas et al. 2016) in continuous time.

    Of the old state (1 - u) ** pace is left, u the update gate: two windows of half the length do
    what one does, and no pace changes nothing.  A convex mix with a tanh stays within [-1, 1].
    """

    def __init__(self, channels: int):
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1)
        self.candidate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        # Update gates from 0.05 to 0.5: memories of two to twenty windows from the start.
        with torch.no_grad():
            self.gates.bias[channels:].copy_(torch.linspace(-3, 0, channels))

    def forward(
        self,
        x: Float[Tensor, "m c h w"],
        state: Float[Tensor, "n c h w"],
        pace: Float[Tensor, "m 1 h w"],
    ) -> tuple[Float[Tensor, "m c h w"], Float[Tensor, "n c h w"]]:
        """Return the state, float32, after every one of m = windows * n steps and after the last.

        `pace` is the time passed, in windows at 120 a second.
        """

        def step(state: Tensor, x: Tensor, pace: Tensor) -> Tensor:
            before = state.to(x.dtype)
            reset, update = self.gates(torch.cat([x, before], 1)).chunk(2, 1)
            candidate = self.candidate(torch.cat([x, reset.sigmoid() * before], 1)).float().tanh()
            # (1 - sigmoid(update)) ** pace, without the infinite slope that a power has at zero.
            keep = torch.exp(-pace * functional.softplus(update.float()))
            return torch.lerp(candidate, state, keep)

        return over_time(step, state, x, pace)


def over_time(
    step: Callable[..., Tensor], state: Float[Tensor, "n ..."], *maps: Float[Tensor, "m ..."]
) -> tuple[Float[Tensor, "m ..."], Float[Tensor, "n ..."]]:
    """Return the state after every window and after the last; `step` takes it and a window's part
    of each of `maps`, which have m = windows * n.
    """
    states = []
    for now in zip(*(part.split(len(state)) for part in maps), strict=True):
        state = step(state, *now)
        states.append(state)
    return torch.cat(states), state


def _leaked(sums: Tensor, keep: Tensor, new: Tensor) -> Tensor:
    return keep * sums + new


def _cast(x: Tensor, dtype: torch.dtype) -> Tensor:
    """Return `x` as a convolution takes it under autocast: sooner, it is copied once only."""
    kind = x.device.type
    return x.to(torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else dtype)


def _seconds(window_s: float | Tensor, voxels: Tensor) -> Tensor:
    """Return the length of the window as (n or 1, 1, 1, 1)."""
    if isinstance(window_s, Tensor):
        return window_s.to(voxels.device).float().view(-1, 1, 1, 1)
    if not 0 < window_s < math.inf:
        raise ValueError(f"window_s must be > 0 seconds, got {window_s}")
    return torch.full((1, 1, 1, 1), window_s, device=voxels.device)


def _time(stirred: Tensor, awake: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
    """Return how awake each block is after the last window and the time that passed there in each,
    in seconds: all of it with events, without any the integral of falling asleep.
    """
    left, passed = torch.exp(-seconds / AWAKE_S), []
    for now in stirred.split(len(awake)):
        passed.append(torch.where(now, seconds, awake * AWAKE_S * (1 - left)))
        awake = torch.where(now, 1.0, awake * left)
    return awake, torch.cat(passed)


def _stirred(coarse: Float[Tensor, "n views hc wc"], local: bool) -> Bool[Tensor, "n 1 h8 w8"]:
    """Return which blocks of 8 x 8 pixels have an event in them or within four pixels around; or,
    if not `local`, anywhere in the picture.
    """
    seen = coarse.abs().amax(1, keepdim=True)
    stirred = functional.max_pool2d(seen, 16 // CELL, 8 // CELL, padding=4 // CELL) > 0
    return stirred if local else stirred.any(-1, True).any(-2, True).expand_as(stirred)


def _halved(x: Tensor) -> Tensor:
    """Return the sums of blocks of 2 x 2, cells, several times faster than avg_pool2d on a CPU."""
    rows = x[..., ::2, :] + x[..., 1::2, :]
    return rows[..., ::2] + rows[..., 1::2]


def grown(x: Tensor, times: int) -> Tensor:
    return functional.interpolate(x, scale_factor=times, mode="nearest")
