"""Training augmentation of voxel sequences (Rebecq et al. 2019; Stoffregen et al. 2020; the paper).

Order: pause, flips, noise, hot pixels.  Crops are drawn before the simulation (sim/pipeline.py).
Every draw comes from the key of the sample, so a batch is the same in any worker.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from src.sim import noise
from src.sim.pipeline import Sample


@dataclass(frozen=True)
class Augment:
    """`noise_std`: standard deviation added to every voxel entry, in events.
    `hot_fraction`: the share of hot pixels of a sequence is uniform in [0, hot_fraction];
    `hot_std`: standard deviation of a hot pixel's value, the same in all bins, views and windows.
    `pause`: probability that a running sequence pauses at a window; `stay`: that a paused one
    stays paused.
    `flip`: probability of a flip, for each axis.
    """

    noise_std: float = 0.4
    hot_fraction: float = 1e-4
    hot_std: float = 0.1
    pause: float = 0.05
    stay: float = 0.9
    flip: float = 0.5

    def __post_init__(self):
        for name in ("hot_fraction", "pause", "stay", "flip"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"augment.{name} must be in [0, 1], got {getattr(self, name)}")
        for name in ("noise_std", "hot_std"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"augment.{name} must be >= 0, got {getattr(self, name)}")

    def __call__(self, sample: Sample, keys: Sequence[int]) -> Sample:
        """Return the augmented sample; `keys` has one key per clip."""
        clips = [self._one(sample, index, key) for index, key in enumerate(keys)]
        voxels, target, turbulent = (torch.stack(part) for part in zip(*clips, strict=True))
        return replace(sample, voxels=voxels, target=target, turbulent=turbulent)

    def _one(self, sample: Sample, index: int, key: int) -> tuple[Tensor, Tensor, Tensor]:
        steps, paused = pause_chain(
            sample.voxels.shape[1], self.pause, self.stay, noise.key(key, "pause")
        )
        axes = flip_axes(self.flip, noise.key(key, "flip"))
        voxels = sample.voxels[index, steps]
        voxels[paused] = 0
        voxels = voxels.flip(axes) if axes else voxels
        voxels = self._corrupt(voxels, key)
        pictures = (sample.target[index, steps], sample.turbulent[index, steps])
        target, turbulent = (part.flip(axes) if axes else part for part in pictures)
        return voxels, target, turbulent

    def _corrupt(self, voxels: Tensor, key: int) -> Tensor:
        if self.noise_std > 0:
            # Device generators differ between CPU and CUDA: same distribution, other numbers.
            drawer = torch.Generator(voxels.device).manual_seed(noise.key(key, "noise"))
            spread = torch.empty_like(voxels).normal_(0, self.noise_std, generator=drawer)
            voxels = voxels + spread
        return voxels + hot_pixels(
            voxels.shape[-2:], self.hot_fraction, self.hot_std, noise.key(key, "hot")
        ).to(voxels)


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


def hot_pixels(size: Sequence[int], fraction: float, std: float, key: int) -> Float[Tensor, "h w"]:
    """Return a picture (h, w) that is zero but at up to `fraction` of the pixels."""
    pixels = size[0] * size[1]
    count = int(float(noise.uniform(key, torch.tensor(0))) * fraction * pixels)
    picture = torch.zeros(pixels)
    places = (noise.uniform(key, 1 + torch.arange(count)) * pixels).long()
    picture[places] = std * noise.normal(noise.key(key, "value"), torch.arange(count))
    return picture.reshape(*size)
