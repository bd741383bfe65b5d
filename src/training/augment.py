"""Training augmentation of voxel sequences (Rebecq et al. 2019; Stoffregen et al. 2020; the paper).

Order: dropped views, pauses, flips, shifted views, noise, hot and noisy pixels.  Every draw comes
from the key of the sample, so a batch is the same in any worker.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from src.sim import noise
from src.sim.optics import Position, layout, most_central_view_index
from src.sim.pipeline import Sample, allocate_float32, concatenate_samples
from src.training.clip_transforms import ClipTransform, transform_batch, transform_clips
from src.training.voxel_noise import add_firing_pixels, draw_normals, draw_pixel_offsets

LEAST_VIEWS_TO_SHIFT = 3
NOISY_PIXEL_RATE_HZ = (10.0, 2000.0)  # each pixel has one of its own, log-uniform


@dataclass(frozen=True)
class Augment:
    """`noise_std`: standard deviation of noise on every voxel entry, in events.
    `max_offset_pixel_fraction`: the share of pixels of a sequence with a constant offset is uniform
    up to this; each offset is normal and the same in all bins, views and windows.
    `max_firing_pixel_fraction`: the share of each view's pixels that fire without a change of light
    is uniform up to this; ON and OFF alike, whole numbers in each bin, see add_firing_pixels.
    `pause_probability_when_running`, `.._when_paused`: that the next window has no events.
    `flip_probability`: for each axis.  The views of a grid change places with their images.
    `view_shift_probability`: of a view to be shifted by up to `max_view_shift_px` whole pixels in
    each axis, where there are three or more: which of two is displaced, nothing tells.
    `batch_view_dropout_probability`: of a batch to lose views, `batch_centre_view_probability`: of
    a batch to have the centre view alone, see draw_kept_views.
    """

    noise_std: float = 0.4
    max_offset_pixel_fraction: float = 1e-4
    max_firing_pixel_fraction: float = 0.0
    pause_probability_when_running: float = 0.05
    pause_probability_when_paused: float = 0.9
    flip_probability: float = 0.5
    view_shift_probability: float = 0.0
    max_view_shift_px: int = 2
    batch_view_dropout_probability: float = 0.0
    batch_centre_view_probability: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(Augment):  # a subclass has others, of ranges of their own
            name, value = field.name, getattr(self, field.name)
            if name in ("noise_std", "max_view_shift_px"):
                if not 0 <= value < float("inf"):
                    raise ValueError(f"augment.{name} must be >= 0, got {value}")
            elif not 0 <= value <= 1:
                raise ValueError(f"augment.{name} must be in [0, 1], got {value}")

    def __call__(
        self, samples: Sequence[Sample], keys: Sequence[int], batched: bool | None = None
    ) -> Sample:
        """Return the augmented batch of the clips of `samples`; `keys` has one key per clip.

        `batched`: in a few operators, else clip by clip, with the same result (None: not on a CPU).
        """
        first = samples[0]
        windows, views, *grid = first.voxels.shape[1:]
        positions = first.positions or layout(views)
        chances = self.batch_view_dropout_probability, self.batch_centre_view_probability
        kept = draw_kept_views(positions, *chances, noise.key(keys[0], "dropped"))
        transforms = [self._draw_transform(key, windows, positions, kept) for key in keys]
        voxels = allocate_float32((len(keys), windows, len(kept), *grid), first.voxels.device)
        if voxels.device.type != "cpu" if batched is None else batched:
            whole = first if len(samples) == 1 else concatenate_samples(samples)
            frames = transform_batch(whole, transforms, voxels)
        else:
            frames = transform_clips(samples, transforms, voxels)
        window_s = torch.cat([sample.window_s for sample in samples])
        self._add_noise(voxels, window_s.tolist(), keys)
        return Sample(
            voxels=voxels,
            window_s=window_s,
            positions=tuple(positions[view] for view in kept),
            parameters=[clip for sample in samples for clip in sample.parameters],
            **frames,
        )

    def _draw_transform(
        self, key: int, windows: int, positions: Sequence[Position], kept: list[int]
    ) -> ClipTransform:
        pauses = self.pause_probability_when_running, self.pause_probability_when_paused
        source, paused = draw_pauses(windows, *pauses, noise.key(key, "pause"))
        axes = draw_flip_axes(self.flip_probability, noise.key(key, "flip"))
        order = flipped_view_order(positions, axes)[kept]
        shift = self.view_shift_probability, self.max_view_shift_px
        several = len(kept) >= LEAST_VIEWS_TO_SHIFT
        shifts = draw_view_shifts(len(kept), *shift, noise.key(key, "misplaced")) if several else []
        return ClipTransform(source, paused, axes, order, shifts)

    def _add_noise(self, voxels: Tensor, window_s: Sequence[float], keys: Sequence[int]) -> None:
        hot = torch.zeros(len(voxels), *voxels.shape[-2:])
        for number, (clip, key) in enumerate(zip(voxels, keys, strict=True)):
            if self.noise_std > 0:
                normals = draw_normals(clip.shape, noise.key(key, "noise"), clip.device)
                clip.add_(normals, alpha=self.noise_std)
            fraction = self.max_offset_pixel_fraction
            hot[number] = draw_pixel_offsets(hot.shape[1:], fraction, noise.key(key, "hot"))
        if hot.any():
            voxels.add_(hot[:, None, None, None].to(voxels))
        if self.max_firing_pixel_fraction:
            counts = [[rate * window for rate in NOISY_PIXEL_RATE_HZ] for window in window_s]
            noise_keys = [noise.key(key, "firing") for key in keys]
            add_firing_pixels(voxels, self.max_firing_pixel_fraction, counts, noise_keys)


def draw_pauses(
    windows: int, probability_when_running: float, probability_when_paused: float, key: int
) -> tuple[Int[Tensor, " windows"], Bool[Tensor, " windows"]]:
    """Return which window of the clip each window is, and whether it is paused.

    A two-state chain.  The first window runs.  A paused one repeats the target of the window before
    it, without events, and the clip goes on after the pause (event_cnn_minimal's semantics).
    """
    source, paused = [0], [False]
    for draw in noise.uniforms(key, windows)[1:]:
        paused.append(draw < (probability_when_paused if paused[-1] else probability_when_running))
        source.append(source[-1] + (not paused[-1]))
    return torch.tensor(source), torch.tensor(paused)


def draw_flip_axes(probability: float, key: int) -> list[int]:
    """Return the axes to flip, out of -2 (vertical) and -1 (horizontal)."""
    draws = noise.uniforms(key, 2)
    return [axis for axis, draw in zip((-2, -1), draws, strict=True) if draw < probability]


def flipped_view_order(positions: Sequence[Position], axes: list[int]) -> Int[Tensor, " views"]:
    """Return for each view which one takes its place when the grid is flipped along `axes` like the
    images.  All stay where that gives another grid.
    """
    here = [tuple(place) for place in positions]
    ends = [min(column) + max(column) for column in zip(*here, strict=True)]
    there = [tuple(ends[a] - p[a] if a - 2 in axes else p[a] for a in (0, 1)) for p in here]
    is_same_grid = set(there) == set(here)
    return torch.tensor([there.index(p) for p in here] if is_same_grid else range(len(here)))


def draw_view_shifts(
    views: int, probability: float, max_shift_px: int, key: int
) -> list[tuple[int, int, int]]:
    """Return (view, down, right) of the views that are shifted, each with `probability`, in whole
    pixels up to `max_shift_px` either way.
    """
    if probability == 0:
        return []
    draws = noise.uniforms(key, 3 * views)
    px = [max_shift_px - int(share * (2 * max_shift_px + 1)) for share in draws]
    triples = zip(range(views), draws[::3], px[1::3], px[2::3], strict=True)
    return [(view, down, right) for view, draw, down, right in triples if draw < probability]


def draw_kept_views(
    positions: Sequence[Position], drop_probability: float, centre_probability: float, key: int
) -> list[int]:
    """Return which of the views at `positions` a batch has: with `centre_probability` the centre
    view alone, else with `drop_probability` some.  Few are left more often than many; one alone is
    the centre view.
    """
    views = len(positions)
    chance, share, *order = noise.uniforms(key, 2 + views)
    if chance >= 1 - centre_probability:
        count = 1
    elif chance >= drop_probability * (1 - centre_probability):
        count = views
    else:
        count = 1 + int(share**2 * (views - 1))
    if count == 1:
        return [most_central_view_index(positions)]
    return sorted(sorted(range(views), key=order.__getitem__)[:count])
