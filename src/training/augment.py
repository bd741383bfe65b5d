"""Training augmentation of voxel sequences (Rebecq et al. 2019; Stoffregen et al. 2020; the paper).

Order: dropped views, pause, turn, misplaced views, noise, hot and firing pixels.  Crops are drawn
before the simulation (sim/pipeline.py).  Every draw comes from the key of the sample, so a batch is
the same in any worker.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor
from torch.nn import functional

from src.sim import noise
from src.sim.optics import Position, layout
from src.sim.pipeline import Sample, room

SHARES = (
    "hot_fraction", "firing_fraction", "pause", "stay", "flip", "transpose", "misplaced", "dropped",
)  # fmt: skip


@dataclass(frozen=True)
class Augment:
    """`noise_std`: standard deviation added to every voxel entry, in events.
    `hot_fraction`: the share of hot pixels of a sequence is uniform in [0, hot_fraction];
    `hot_std`: standard deviation of a hot pixel's value, the same in all bins, views and windows.
    `firing_fraction`: the share of pixels of each view that fire on their own, whatever the light,
    is uniform in [0, firing_fraction]; `firing_hz`: each at a rate log-uniform in this range, 1/s,
    ON and OFF alike.  What E2VID calls hot does not come and go; a camera's hot pixels do.
    `pause`: probability that a running sequence pauses at a window; `stay`: that a paused one
    stays paused.
    `flip`: probability of a flip, for each axis; `transpose`: that rows and columns change places.
    The views of a grid change places with their pictures.
    `misplaced`: probability of a view to lie up to `misplaced_px` whole pixels off, in each axis.
    `dropped`: probability of a batch to lose views, any of them, one or more but never all.
    """

    noise_std: float = 0.4
    hot_fraction: float = 1e-4
    hot_std: float = 0.1
    firing_fraction: float = 0.0
    firing_hz: Sequence[float] = (10.0, 2000.0)
    pause: float = 0.05
    stay: float = 0.9
    flip: float = 0.5
    transpose: float = 0.0
    misplaced: float = 0.0
    misplaced_px: int = 2
    dropped: float = 0.0

    def __post_init__(self):
        for name in SHARES:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"augment.{name} must be in [0, 1], got {getattr(self, name)}")
        for name in ("noise_std", "hot_std"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"augment.{name} must be >= 0, got {getattr(self, name)}")
        ends = list(self.firing_hz)
        if len(ends) != 2 or not 0 < ends[0] <= ends[1] < float("inf"):
            raise ValueError(f"augment.firing_hz must be [low, high] above 0, got {ends}")
        if self.misplaced_px < 0:
            raise ValueError(f"augment.misplaced_px must be >= 0, got {self.misplaced_px}")

    def __call__(self, samples: Sequence[Sample], keys: Sequence[int]) -> Sample:
        """Return the augmented batch of `samples`, a clip each; `keys` has one key per clip."""
        first = samples[0]
        windows, views, *grid = first.voxels.shape[1:]
        places = first.positions or layout(views)
        kept = views_kept(views, self.dropped, noise.key(keys[0], "dropped"))
        voxels = room((len(keys), windows, len(kept), *grid), first.voxels.device)
        pictures = [
            self._one(sample, key, kept, out)
            for sample, key, out in zip(samples, keys, voxels, strict=True)
        ]
        pictures = [torch.stack(part) for part in zip(*pictures, strict=True)]
        target, turbulent, *taught = pictures
        return Sample(
            voxels=voxels,
            target=target,
            turbulent=turbulent,
            window_s=torch.cat([sample.window_s for sample in samples]),
            positions=tuple(places[view] for view in kept),
            drawn=[drawn for sample in samples for drawn in sample.drawn],
            taught=taught[0] if taught else None,
        )

    def _one(self, sample: Sample, key: int, kept: list[int], out: Tensor) -> list[Tensor]:
        """Fill `out` (windows, kept, bins, h, w); return the pictures: clean, turbulent, taught."""
        voxels = sample.voxels[0]
        steps, paused = pause_chain(len(voxels), self.pause, self.stay, noise.key(key, "pause"))
        axes = flip_axes(self.flip, noise.key(key, "flip"))
        swap = float(noise.uniform(noise.key(key, "transpose"), torch.tensor(0))) < self.transpose
        order = turned_views(sample.positions, voxels.shape[1], axes, swap)[kept].to(voxels.device)
        turn = partial(turned, axes=axes, swap=swap)
        show(out, voxels, steps, paused, lambda part: turn(part.index_select(-4, order)))
        misplace(out, self.misplaced, self.misplaced_px, noise.key(key, "misplaced"))
        self._corrupt(out, float(sample.window_s[0]), key)
        pictures = (sample.target, sample.turbulent, sample.taught)
        return [turn(part[0, steps]) for part in pictures if part is not None]

    def _corrupt(self, voxels: Tensor, window_s: float, key: int) -> None:
        if self.noise_std > 0:
            spread = normals(voxels.shape, noise.key(key, "noise"), voxels.device)
            voxels.add_(spread, alpha=self.noise_std)
        hot = hot_pixels(voxels.shape[-2:], self.hot_fraction, self.hot_std, noise.key(key, "hot"))
        if hot.any():
            voxels.add_(hot.to(voxels))
        rates = [rate * window_s for rate in self.firing_hz]
        fire(voxels, self.firing_fraction, rates, noise.key(key, "firing"))


def show(
    out: Float[Tensor, "windows kept bins h w"],
    voxels: Float[Tensor, "windows views bins h w"],
    steps: Int[Tensor, " windows"],
    paused: Bool[Tensor, " windows"],
    turn: Callable[[Tensor], Tensor],
) -> None:
    """Fill `out` with the windows `steps` as `turn` makes them, and with nothing where `paused`."""
    if out.device.type != "cpu":
        out.copy_(turn(voxels[steps.to(out.device)]))
        out[paused.to(out.device)] = 0
        return
    for window, step, empty in zip(out, steps.tolist(), paused.tolist(), strict=True):
        if empty:
            window.zero_()
        else:  # window by window: what is turned is in the cache still
            window.copy_(turn(voxels[step]))


def normals(shape: Sequence[int], key: int, device: torch.device) -> Tensor:
    """Return standard normals; on the CPU of 2^16 levels up to 4.2 away from 0, at half the cost.

    The devices draw other numbers from the same distribution.
    """
    if device.type != "cpu":
        drawer = torch.Generator(device).manual_seed(key)
        return torch.empty(shape, device=device).normal_(generator=drawer)
    count = math.prod(shape)
    words = np.random.SFC64(key).random_raw(-(-count // 4)).view(np.uint16)
    return torch.from_numpy(QUANTILES[words[:count]]).reshape(shape)


def quantiles(levels: int) -> NDArray[np.float32]:
    """Return the standard normal's quantiles at equal steps, of deviation 1 in all."""
    values = ndtri((np.arange(levels) + 0.5) / levels)
    return (values / values.std()).astype(np.float32)


QUANTILES = quantiles(2**16)


def pause_chain(
    windows: int, pause: float, stay: float, key: int
) -> tuple[Int[Tensor, " windows"], Tensor]:
    """Return which window each step shows (windows,) and whether it is paused (windows,) bool.

    A two-state chain.  The first step runs.  A paused step repeats the target of the window shown
    last, without events, and the clip goes on after the pause (event_cnn_minimal's semantics).
    """
    draws = noise.uniform(key, torch.arange(windows)).tolist()
    steps, paused = [0], [False]
    for draw in draws[1:]:
        paused.append(draw < (stay if paused[-1] else pause))
        steps.append(steps[-1] + (not paused[-1]))
    return torch.tensor(steps), torch.tensor(paused)


def flip_axes(probability: float, key: int) -> list[int]:
    """Return the axes to flip, out of -2 (upside down) and -1 (mirrored)."""
    draws = noise.uniform(key, torch.arange(2)).tolist()
    return [axis for axis, draw in zip((-2, -1), draws, strict=True) if draw < probability]


def turned(pictures: Tensor, axes: list[int], swap: bool) -> Tensor:
    """Return pictures (..., h, w) flipped along `axes`, then with rows and columns swapped."""
    if swap and pictures.shape[-2] != pictures.shape[-1]:
        height, width = pictures.shape[-2:]
        raise ValueError(
            f"augment.transpose must be 0 for crops that are no squares, got {height} x {width}"
        )
    pictures = pictures.flip(axes) if axes else pictures
    return pictures.mT if swap else pictures


def turned_views(
    positions: Sequence[Position] | None, views: int, axes: list[int], swap: bool
) -> Int[Tensor, " views"]:
    """Return for each view which one's picture, turned, is seen there: that which stands there when
    the grid is turned with the pictures.  All stay where a turned grid is another one.
    """
    here = [tuple(place) for place in positions or layout(views)]
    ends = [min(column) + max(column) for column in zip(*here, strict=True)]
    flipped = [[ends[a] - p[a] if a - 2 in axes else p[a] for a in (0, 1)] for p in here]
    there = [tuple(place[::-1] if swap else place) for place in flipped]
    same = set(there) == set(here)
    return torch.tensor([there.index(place) for place in here] if same else range(len(here)))


def misplace(
    voxels: Float[Tensor, "windows views bins h w"], probability: float, reach: int, key: int
) -> Float[Tensor, "windows views bins h w"]:
    """Move each view, at `probability`, by up to `reach` pixels; nothing comes in at the border."""
    if probability == 0:
        return voxels
    height, width = voxels.shape[-2:]
    draws = noise.uniform(key, torch.arange(3 * voxels.shape[1]).reshape(-1, 3)).tolist()
    for view, (chance, *place) in enumerate(draws):
        if chance < probability:
            down, across = (int(share * (2 * reach + 1)) for share in place)
            wide = functional.pad(voxels[:, view], (reach,) * 4)
            voxels[:, view] = wide[..., down : down + height, across : across + width]
    return voxels


def views_kept(views: int, probability: float, key: int) -> list[int]:
    """Return which views a batch has: at `probability` some are lost; how many is uniform."""
    chance, share, *order = noise.uniform(key, torch.arange(2 + views)).tolist()
    if chance >= probability or views == 1:
        return list(range(views))
    count = 1 + int(share * (views - 1))
    return sorted(sorted(range(views), key=order.__getitem__)[:count])


def hot_pixels(size: Sequence[int], fraction: float, std: float, key: int) -> Float[Tensor, "h w"]:
    """Return a picture (h, w) that is zero but at up to `fraction` of the pixels."""
    pixels = size[0] * size[1]
    drawn = noise.uniform(noise.key(key, "count"), torch.arange(2))
    count = up_to(fraction * pixels, *drawn.tolist())
    picture = torch.zeros(pixels)
    places = (noise.uniform(key, torch.arange(count)) * pixels).long()
    picture[places] = std * noise.normal(noise.key(key, "value"), torch.arange(count))
    return picture.reshape(*size)


def up_to(most: float, share: float, part: float) -> int:
    """Return a number of pixels uniform in [0, most], for `share` and `part` uniform in [0, 1).

    Rounded up as often as what is over is large: 0.4 pixels are one in two crops of five, not none.
    """
    return int(share * most + part)


def fire(
    voxels: Float[Tensor, "windows views bins h w"],
    fraction: float,
    often: Sequence[float],
    key: int,
) -> None:
    """Let up to `fraction` of each view's pixels fire on their own: in a window each has as many
    events as a Poisson process of a mean log-uniform in `often` = (low, high), each ON or OFF.
    """
    if fraction == 0:
        return
    windows, _, bins, height, width = voxels.shape
    drawer = np.random.Generator(np.random.SFC64(key))
    for seen in voxels.unbind(1):
        count = up_to(fraction * height * width, *drawer.random(2))
        rows, columns = drawer.integers([[height], [width]], size=(2, count))
        mean = np.exp(drawer.uniform(*np.log(often), count)) / (2 * bins)
        on, off = drawer.poisson(mean, (2, windows, bins, count))
        seen[..., rows, columns] += torch.from_numpy(on - off).to(voxels)
