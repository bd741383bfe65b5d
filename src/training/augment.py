"""Training augmentation of voxel sequences (Rebecq et al. 2019; Stoffregen et al. 2020; the paper).

Order: dropped views, pause, turn, misplaced views, noise, hot and firing pixels.  Crops are drawn
before the simulation (sim/pipeline.py).  Every draw comes from the key of the sample, so a batch is
the same in any worker.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from src.sim import noise
from src.sim.optics import Position, layout
from src.sim.pipeline import Sample, joined, room
from src.training.rearrange import Change, rearrange_batch, rearrange_clips
from src.training.voxel_noise import fire, hot_pixels, normals

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

    def __call__(
        self, samples: Sequence[Sample], keys: Sequence[int], at_once: bool | None = None
    ) -> Sample:
        """Return the augmented batch of the clips of `samples`; `keys` has one key per clip.

        `at_once`: all clips in a few operators, as a GPU wants it, or clip by clip, as a CPU's
        cache does (None: by the device).  Both give the same, but for how a device draws `noise`.
        """
        first = samples[0]
        windows, views, *grid = first.voxels.shape[1:]
        kept = views_kept(views, self.dropped, noise.key(keys[0], "dropped"))
        changes = [self._draw(key, windows, views, first.positions, kept) for key in keys]
        voxels = room((len(keys), windows, len(kept), *grid), first.voxels.device)
        if at_once is None:
            at_once = voxels.device.type != "cpu"
        if at_once:
            whole = first if len(samples) == 1 else joined(samples)
            pictures = rearrange_batch(whole, changes, voxels)
        else:
            pictures = rearrange_clips(samples, changes, voxels)
        window_s = torch.cat([sample.window_s for sample in samples])
        self._corrupt(voxels, window_s.tolist(), keys)
        places = first.positions or layout(views)
        target, turbulent, *taught = pictures
        return Sample(
            voxels=voxels,
            target=target,
            turbulent=turbulent,
            window_s=window_s,
            positions=tuple(places[view] for view in kept),
            drawn=[drawn for sample in samples for drawn in sample.drawn],
            taught=taught[0] if taught else None,
        )

    def _draw(self, key: int, windows: int, views: int, positions, kept: list[int]) -> Change:
        steps, paused = pause_chain(windows, self.pause, self.stay, noise.key(key, "pause"))
        axes = flip_axes(self.flip, noise.key(key, "flip"))
        swap = noise.uniforms(noise.key(key, "transpose"), 1)[0] < self.transpose
        order = turned_views(positions, views, axes, swap)[kept]
        away = misplacements(
            len(kept), self.misplaced, self.misplaced_px, noise.key(key, "misplaced")
        )
        return Change(steps, paused, axes, swap, order, away)

    def _corrupt(self, voxels: Tensor, window_s: Sequence[float], keys: Sequence[int]) -> None:
        """Add noise, hot and firing pixels to the clips of a batch."""
        hot = torch.zeros(len(voxels), *voxels.shape[-2:])
        for number, (clip, key) in enumerate(zip(voxels, keys, strict=True)):
            if self.noise_std > 0:
                spread = normals(clip.shape, noise.key(key, "noise"), clip.device)
                clip.add_(spread, alpha=self.noise_std)
            drawn = noise.key(key, "hot")
            hot[number] = hot_pixels(hot.shape[1:], self.hot_fraction, self.hot_std, drawn)
        if hot.any():
            voxels.add_(hot[:, None, None, None].to(voxels))
        rates = [[rate * window for rate in self.firing_hz] for window in window_s]
        drawn = [noise.key(key, "firing") for key in keys]
        fire(voxels, self.firing_fraction, rates, drawn)


def pause_chain(
    windows: int, pause: float, stay: float, key: int
) -> tuple[Int[Tensor, " windows"], Tensor]:
    """Return which window each step shows (windows,) and whether it is paused (windows,) bool.

    A two-state chain.  The first step runs.  A paused step repeats the target of the window shown
    last, without events, and the clip goes on after the pause (event_cnn_minimal's semantics).
    """
    draws = noise.uniforms(key, windows)
    steps, paused = [0], [False]
    for draw in draws[1:]:
        paused.append(draw < (stay if paused[-1] else pause))
        steps.append(steps[-1] + (not paused[-1]))
    return torch.tensor(steps), torch.tensor(paused)


def flip_axes(probability: float, key: int) -> list[int]:
    """Return the axes to flip, out of -2 (upside down) and -1 (mirrored)."""
    draws = noise.uniforms(key, 2)
    return [axis for axis, draw in zip((-2, -1), draws, strict=True) if draw < probability]


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


def misplacements(
    views: int, probability: float, reach: int, key: int
) -> list[tuple[int, int, int]]:
    """Return (view, rows, columns) of the views that move, each at `probability`, by so many pixels
    up and to the left, up to `reach` either way.
    """
    if probability == 0:
        return []
    draws = noise.uniforms(key, 3 * views)
    moved = [view for view in range(views) if draws[3 * view] < probability]
    return [
        (view, *(int(share * (2 * reach + 1)) - reach for share in draws[3 * view + 1 :][:2]))
        for view in moved
    ]


def views_kept(views: int, probability: float, key: int) -> list[int]:
    """Return which views a batch has: at `probability` some are lost; how many is uniform."""
    chance, share, *order = noise.uniforms(key, 2 + views)
    if chance >= probability or views == 1:
        return list(range(views))
    count = 1 + int(share * (views - 1))
    return sorted(sorted(range(views), key=order.__getitem__)[:count])
