"""SetNet, ours: frames from any number of views, at any rate, at a fraction of E2VID's cost.

Views come in as a set: a view's kernel follows from its position, so the first layer is a stack of
views with weights made for whoever is there; the spread across views says where they agree.  Leaky
sums of events give the network a memory from its first step.  Time passes in seconds, not in
windows, and only while events come: one set of weights serves 120 and 12,000 windows a second, and
a picture without events stays.

half resolution: stem, memory -> what lies around, at a quarter, an eighth, a sixteenth -> 2 x 2
pixels.  One looks around at most 30 times a second; what was seen there goes into a running mean,
and the picture fades to that, so that areas do not change in steps (docs/decisions/0021 to 0024).
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from src.models.layers import pad_to_multiple
from src.models.setnet_layers import Even, PacedUnit, Surroundings, ViewKernels, grown, over_time
from src.sim.optics import layout

SIZES = {  # channels; multiply-accumulates at 176 x 176 with nine views: 0.34, 1.2 and 3.5 G
    "small": {"half": 16, "around": [32, 64, 96]},
    "medium": {"half": 40, "around": [56, 96, 128], "refined": True, "rank": 32},
    "large": {"half": 64, "around": [128, 192, 256], "refined": True, "rank": 32},
}
MEMORIES_S = (0.05, 0.5)  # time constants of the leaky sums
AWAKE_S = 0.005  # time constant by which a picture falls asleep after its last event
RATE = 120.0  # windows a second at which a gate is taken as it is
LOOK_S = 1 / 30  # what passes until one looks around again ...
DUE = math.exp(-0.98)  # ... by how recent that is then; 2 % for rounding
FADE_S = 1 / 60  # time constant by which a picture follows what was seen around
MAX_VIEWS = 25
CELL = 2  # pixels: side of what the first layer sees as one
BORDER = 2  # cells beyond the border that the layers which draw see

Position = tuple[int, int]
State = tuple[Tensor, ...]


class SetNet(nn.Module):
    """Voxel grids of 1 to 25 views to frames in [0, 1], window by window.

    `half`: channels at half resolution; `around`: at a quarter and each coarser one; `refined`:
    see Surroundings; `rank`: see PacedUnit.  The order of the views is free but the same in all
    windows of a sequence.
    """

    views = None

    def __init__(
        self,
        bins: int = 5,
        half: int = 16,
        around: Sequence[int] = (32, 64, 96),
        refined: bool = False,
        rank: int | None = None,
    ):
        super().__init__()
        self.arguments = {"bins": bins, "half": half, "around": list(around)}  # that make it again
        self.arguments |= {"refined": True} if refined else {}
        self.arguments |= {"rank": rank} if rank else {}
        self.bins, self.half, memories = bins, half, len(MEMORIES_S)
        self.voxel_stem = ViewKernels(bins, half, 5)
        self.sum_stem = ViewKernels(memories, half, 3)
        self.spread_stem = nn.Conv2d(memories, half, 3, padding=1, bias=False)
        self.cell2 = PacedUnit(half, rank)
        self.around = Surroundings(half, around, refined)
        self.mix2 = nn.Conv2d(half, half, 3, padding=BORDER, padding_mode="replicate")
        self.shuffle = Even(half, CELL**2, 3)
        self.relu = nn.ReLU()
        self.frozen: dict[tuple, tuple[Tensor, ...]] | None = None  # kernels kept, for running

    @classmethod
    def preset(cls, size: str, bins: int = 5) -> "SetNet":
        """Return the network of a `size`: small, medium or large; ValueError for another."""
        if size not in SIZES:
            raise ValueError(f"model.size must be one of {', '.join(SIZES)}, got {size}")
        return cls(bins, **SIZES[size])

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
        State, float32: leaky sums of each view, in cells, how awake each picture is, how recently
        one looked around, 1 just now, 0 never, and the maps of `hidden`.  Raises ValueError for
        bins, a number of views, a length of window or a state that do not fit.
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
        shown: Sequence[int] | None = None,
    ) -> tuple[Float[Tensor, "n shown 1 h w"], State]:
        """Return the frames of the windows `shown` (None: of all), as window by window, and the
        state after the last one.

        Layer by layer: only what is remembered goes window by window, all else sees all of them at
        once, in order of time (windows * n), and what is drawn those that are shown.
        """
        n, windows, views, bins, height, width = voxels.shape
        places = self.places(views, bins, positions)
        seconds = _seconds(window_s, voxels)
        padded, (top, left) = pad_to_multiple(voxels.flatten(0, 2), 8)
        voxels = padded.unflatten(0, (n, windows, views)).transpose(0, 1)
        cells = _halved(voxels.float().sum(3).flatten(0, 1))
        sums, awake, recent, hidden, about, told = self._start(state, cells[:n])

        awake, passed = _time(cells, awake, seconds)
        recent, before, due = _looks(passed, recent)
        kept = torch.stack([torch.exp(-passed / memory) for memory in MEMORIES_S], 2)
        every, sums = over_time(_leaked, sums, kept, cells[:, :, None])
        spread = (every - every.mean(1, keepdim=True)).abs().mean(1)

        grids, memories, bias = self.kernels(places)
        stacked = _cast(voxels.flatten(2, 3), grids.dtype)
        stem = functional.conv2d(stacked, grids, None, CELL, grids.shape[-1] // 2)
        memory = _cast(torch.cat([every.flatten(1, 2), spread], 1)[None], memories.dtype)
        stem = _as_rates(stem, seconds) + functional.conv2d(memory, memories, bias, 1, 1)
        seen, hidden = self.fine(stem, passed, hidden)
        around, about = self.looked(seen, about, before, due)
        fading, told = over_time(faded, told, around, passed)
        if shown is not None:
            seen, fading = (_windows(maps, n, shown) for maps in (seen, fading))
        frames = functional.pixel_shuffle(self.drawn(seen, fading), CELL).sigmoid()
        frames = frames[..., top : top + height, left : left + width]
        frames = frames.unflatten(0, (-1, n)).transpose(0, 1)
        return frames, (sums, awake, recent, hidden, about, told)

    def fine(
        self, stem: Float[Tensor, "m c h2 w2"], passed: Float[Tensor, "m 1 1 1"], hidden: Tensor
    ) -> tuple[Float[Tensor, "m c h2 w2"], Tensor]:
        """Return what is known at half resolution after each of m = windows * n, and the hidden map
        after the last; `stem`: before its ReLU, `passed`: seconds.
        """
        seen, hidden = self.cell2(self.relu(stem), hidden, RATE * passed)
        return seen.to(stem.dtype), hidden

    def looked(
        self,
        seen: Float[Tensor, "m c h2 w2"],
        about: Float[Tensor, "n c h4 w4"],
        recent: Float[Tensor, "m 1 1 1"],
        due: Bool[Tensor, "m 1 1 1"],
    ) -> tuple[Float[Tensor, "m c h4 w4"], Float[Tensor, "n c h4 w4"]]:
        """Return what lies around, float32, in each of m = windows * n and after the last; `about`:
        before the first, `due`: whether one looks, `recent`: how recently one had.
        """
        if len(seen) == len(about) or seen.is_cuda:
            # An export, or a GPU that would wait for it, has shapes that do not depend on `due`.
            now = self.around(seen).float()
        else:  # the windows in which nobody looks do not count
            looks = due.flatten().nonzero().flatten()
            now = about.new_zeros(len(seen), *about.shape[1:])
            now = now.index_copy(0, looks, self.around(seen[looks]).float())

        def step(before: Tensor, now: Tensor, recent: Tensor, due: Tensor) -> Tensor:
            return torch.where(due, self.around.mean(before, now, recent), before)

        return over_time(step, about, now, recent, due)

    def drawn(
        self, seen: Float[Tensor, "m c h2 w2"], told: Float[Tensor, "m c h4 w4"]
    ) -> Float[Tensor, "m pixels _h2 _w2"]:
        """Return the pixels of each cell (with `FourCells`, of 2 x 2 cells) as channels, float32,
        before their sigmoid; `told`: of what lies around.  Maps go on beyond the border as they are
        there: zeros would make a pattern of its pixels.
        """
        x = self.relu(grown(told.to(seen.dtype), 2) + seen)
        return self.shuffle(self.relu(self.mix2(x))).float()

    def kernels(self, places: tuple[Position, ...]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the kernels of the stem for views that stand at `places`: of the stacked grids
        (stem, views * bins, 5, 5), of the stacked sums and their spread, and the bias.
        """
        device = self.shuffle.bias.device
        if self.frozen is not None and (places, device) in self.frozen:
            return self.frozen[places, device]
        stood = _on_device(places, device).float()
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
        """Return where the views stand; ValueError for bins or views that do not fit."""
        if bins != self.bins:
            raise ValueError(f"bins must be {self.bins} for this network, got {bins}")
        if not 1 <= views <= MAX_VIEWS:
            raise ValueError(f"optics.views must be in 1..{MAX_VIEWS}, got {views}")
        positions = layout(views) if positions is None else positions
        if len(positions) != views:
            raise ValueError(f"optics.positions must be {views} (row, col), got {positions}")
        return tuple((int(row), int(column)) for row, column in positions)

    def hidden(self, height: int, width: int) -> list[tuple[int, int, int]]:
        """Return the sizes (c, h, w) of the hidden maps of a picture: what is remembered at half
        resolution, in [-1, 1], what lies around, at a quarter, and what is told of that.
        """
        return [(self.half, height // k, width // k) for k in (2, 4, 4)]

    def _start(self, state: State | None, cells: Tensor) -> State:
        """Return `state`, or zeros of the right sizes; ValueError when they are not right."""
        n, views, rows, columns = cells.shape
        maps = self.hidden(CELL * rows, CELL * columns)
        sizes = [
            (n, views, len(MEMORIES_S), rows, columns),
            *[(n, 1, 1, 1)] * 2,
            *((n, *size) for size in maps),
        ]
        if state is None:
            return tuple(cells.new_zeros(size) for size in sizes)
        found = [tuple(part.shape) for part in state]
        if found != sizes:
            raise ValueError(f"state must have sizes {sizes} for these voxels, got {found}")
        return state


def faded(told: Tensor, about: Tensor, passed: Tensor) -> Tensor:
    """Return what is told of what lies around, `passed` seconds after what was told before."""
    return torch.lerp(about, told, torch.exp(-passed / FADE_S))


def _leaked(sums: Tensor, keep: Tensor, new: Tensor) -> Tensor:
    return keep * sums + new


def _windows(maps: Tensor, n: int, shown: Sequence[int]) -> Tensor:
    """Return those of `maps` (windows * n, ...) that are of the windows `shown`."""
    chosen = _on_device(tuple(shown), maps.device)
    return maps.unflatten(0, (-1, n)).index_select(0, chosen).flatten(0, 1)


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _on_device(numbers: tuple, device: torch.device) -> Int[Tensor, "..."]:
    """Return whole numbers as a tensor; kept, as a CUDA graph can copy nothing to the device."""
    return torch.tensor(numbers, dtype=torch.long, device=device)


def _cast(x: Float[Tensor, "windows n c h w"], dtype: torch.dtype) -> Float[Tensor, "m c h w"]:
    """Return the maps of m = windows * n as a convolution takes them under autocast, channels last:
    in one copy.
    """
    kind = x.device.type
    dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else dtype
    windows, n, c, h, w = x.shape
    maps = torch.empty(
        windows * n, c, h, w, dtype=dtype, device=x.device, memory_format=torch.channels_last
    )
    maps.unflatten(0, (windows, n)).copy_(x)
    return maps


def _as_rates(counted: Tensor, seconds: Tensor) -> Tensor:
    """Return maps (windows * n, ...) of what a window counts as counts in 1 / RATE s."""
    often = 1 / (RATE * seconds)
    return counted * often.repeat(len(counted) // len(often), 1, 1, 1).to(counted.dtype)


def _seconds(window_s: float | Tensor, voxels: Tensor) -> Tensor:
    """Return the length of the window as (n or 1, 1, 1, 1)."""
    if isinstance(window_s, Tensor):
        return window_s.to(voxels.device).float().view(-1, 1, 1, 1)
    if not 0 < window_s < math.inf:
        raise ValueError(f"window_s must be > 0 seconds, got {window_s}")
    return torch.full((1, 1, 1, 1), window_s, device=voxels.device)


def _time(cells: Tensor, awake: Tensor, seconds: Tensor) -> tuple[Tensor, Tensor]:
    """Return how awake each picture is after the last window and the time that passed there in
    each, in seconds: all of it with events, without any the integral of falling asleep.
    """
    left, passed = torch.exp(-seconds / AWAKE_S), []
    for stirred in (cells.abs().amax((1, 2, 3), keepdim=True) > 0).split(len(awake)):
        passed.append(torch.where(stirred, seconds, awake * AWAKE_S * (1 - left)))
        awake = torch.where(stirred, 1.0, awake * left)
    return awake, torch.cat(passed)


def _looks(passed: Tensor, recent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return how recently one looked around after the last window and, in each, before one may
    look again, and whether one does.
    """
    before, due = [], []
    for now in passed.split(len(recent)):
        recent = recent * torch.exp(-now / LOOK_S)
        before.append(recent)
        due.append((recent <= DUE) & (now > 0))
        recent = torch.where(due[-1], 1.0, recent)
    return recent, torch.cat(before), torch.cat(due)


def _halved(x: Tensor) -> Tensor:
    """Return the sums of blocks of 2 x 2, cells, several times faster than avg_pool2d on a CPU."""
    rows = x[..., ::2, :] + x[..., 1::2, :]
    return rows[..., ::2] + rows[..., 1::2]
