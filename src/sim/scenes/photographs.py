"""Clean clips: photographs in smooth planar motion behind moving cut-outs of other photographs.

The recipe E2VID was trained with (Rebecq et al. 2019; ESIM's multi-object renderer, Rebecq et al.
2018), as a function of time in seconds: the same clip at k times the frame rate holds the same
frames with k - 1 more between any two.  Known-motion targets: targets.py, before photographs:
targets_on_photographs.py; REDS and videos: footage.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from src.sim import noise
from src.sim.scenes.motion import Motion, Tempo
from src.sim.scenes.photo_files import Root, check_split, only_for_training, photographs, read
from src.sim.scenes.photo_layers import Layer, ReturningLayer, blob, render, smooth

REFERENCE_WIDTH = 256  # of the frame that `zoom` speaks of
CUTOUT_SIDE = 192  # of a cut-out's texture


@dataclass(frozen=True)
class Clip:
    """`frames` (frames, h, w) float32 in [0, 1], code values; `truth`: the path (frames, 2) of a
    known target's centre (x, y) in pixels, where there is one; `lamp`: the factor in (0, 1] that a
    flickering lamp puts on the light of each frame, which `frames`, the ground truth, are without.
    """

    frames: Float[Tensor, "frames h w"]
    fps: float
    name: str
    truth: Float[Tensor, "frames 2"] | None = None
    lamp: Float[Tensor, " frames #h #w"] | None = None


class Photographs:
    """Endless clips of photographs in motion.

    `root`: a folder of photographs, searched recursively, a pack of them (scripts/pack_scenes.py),
    or several of either (None: those inside scikit-image); 10 % of each serve `val` and 20 %
    `test`.  `train_root`: as `root`, more photographs, which serve training only.  `speed`: range
    of the drift, in frame widths per second; `zoom`: range of photograph pixels per pixel of a
    frame 256 wide; `cutouts`: most foreground objects, `cutout_sizes` the range of their sides in
    frame widths; `cutouts_return`: they turn about their own middle and come in again opposite
    where they left.  `still`: probability that only these move; `rest`: that all pauses, stops or
    never moves.  Raises ValueError where there are no photographs, or for a value outside its
    range.
    """

    def __init__(
        self,
        root: Root = None,
        *,
        train_root: Root = None,
        split: str = "train",
        seed: int = 0,
        height: int = 256,
        width: int = 256,
        frames: int = 41,
        fps: float = 120.0,
        speed: Sequence[float] = (0.1, 1.5),
        zoom: Sequence[float] = (0.9, 1.6),
        cutouts: int = 3,
        cutout_sizes: Sequence[float] = (0.15, 0.5),
        cutouts_return: bool = False,
        still: float = 0.0,
        rest: float = 0.0,
    ):
        check_frames(height, width, frames, fps, split)
        ranges = {"speed": speed, "zoom": zoom, "cutout_sizes": cutout_sizes}
        for name, (low, high) in ranges.items():
            if not 0 < low <= high < math.inf:
                raise ValueError(f"scene.{name} must be a range 0 < low <= high, got {low}, {high}")
        if cutouts < 0:
            raise ValueError(f"scene.cutouts must be >= 0, got {cutouts}")
        for name, value in (("still", still), ("rest", rest)):
            check_share(name, value)
        self.photos = photographs(root, split)
        if split == "train":
            self.photos += only_for_training(train_root, root)
        self.split, self.seed, self.size = split, seed, (height, width)
        self.times = np.arange(frames) / fps
        self.fps, self.speed, self.zoom = fps, speed, zoom
        self.cutouts, self.cutout_sizes = cutouts, cutout_sizes
        self.cutout = ReturningLayer if cutouts_return else Layer
        self.still, self.rest = still, rest

    def clip(self, index: int) -> Clip:
        """Return clip `index`: a function of the seed, the split and the index."""
        key = noise.key(self.seed, self.split, "photographs", index)
        rng = np.random.default_rng(key)
        apart = np.random.default_rng(noise.key(key, "tempo"))  # `rng` draws as it did without
        still, rests = apart.uniform(size=2) < (self.still, self.rest)
        name, picture = self._photo(rng)
        layers = [background(picture, self.zoom, self.size, rng, self.speed)]
        if still:
            layers[0].motion.stop()
        objects = max(rng.integers(self.cutouts + 1), int(still and self.cutouts > 0))
        layers += [self._cutout(rng) for _ in range(objects)]
        gain, offset = rng.uniform(0.75, 1.0), rng.uniform(-0.1, 0.1)
        times = map(Tempo(apart), self.times) if rests else self.times
        frames = np.stack([render(layers, time, self.size) for time in times])
        frames = np.clip(0.5 + offset + gain * (frames - 0.5), 0, 1).astype(np.float32)
        return Clip(torch.from_numpy(frames), self.fps, f"{name}-{index}")

    def _photo(self, rng: np.random.Generator) -> tuple[str, NDArray]:
        photo = self.photos[rng.integers(len(self.photos))]
        return photo.stem, read(photo)

    def _cutout(self, rng: np.random.Generator) -> Layer:
        _, photo = self._photo(rng)
        top, left = (rng.integers(max(1, n - CUTOUT_SIDE)) for n in photo.shape)
        texture = photo[top : top + CUTOUT_SIDE, left : left + CUTOUT_SIDE]
        side = rng.uniform(*self.cutout_sizes)
        zoom = max(texture.shape) / (side * self.size[1])
        mask = smooth(blob(texture.shape, rng), zoom)
        # Where the cut-out stands at t = 0, as seen from its own middle.
        place = rng.uniform(-0.5, 0.5, 2) * self.size[::-1]
        centre = np.array(texture.shape[::-1]) / 2 - place * zoom
        motion = Motion(rng, self.speed)
        return self.cutout(smooth(texture, zoom), mask, centre, zoom, motion)


def background(
    photo: NDArray,
    zooms: Sequence[float],
    size: tuple[int, int],
    rng: np.random.Generator,
    speed: Sequence[float],
) -> Layer:
    """Return the layer behind all others: a photograph about its middle in a frame of `size`."""
    zoom = rng.uniform(*zooms) * REFERENCE_WIDTH / size[1]
    centre = rng.uniform(0.35, 0.65, 2) * photo.shape[::-1]
    return Layer(smooth(photo, zoom), None, centre, zoom, Motion(rng, speed))


class MixedRates:
    """Scenes that differ in frame rate: clip k is that of one of them, drawn by its number."""

    def __init__(self, scenes: Sequence):
        self.scenes = list(scenes)

    def clip(self, index: int) -> Clip:
        """Return clip `index` of the scene drawn for it."""
        draw = float(noise.uniform(noise.key("rate"), torch.tensor(index)))
        return self.scenes[int(draw * len(self.scenes))].clip(index)


def check_frames(height: int, width: int, frames: int, fps: float, split: str) -> None:
    """Raise ValueError for a size, a number of frames, a rate or a split that no clip can have."""
    check_split(split)
    for name, value, least in (("height", height, 8), ("width", width, 8), ("frames", frames, 2)):
        if value < least:
            raise ValueError(f"scene.{name} must be >= {least}, got {value}")
    if not 0 < fps < math.inf:
        raise ValueError(f"fps must be > 0, got {fps}")


def check_share(name: str, value: float) -> None:
    """Raise ValueError for a probability outside [0, 1], or nan."""
    if not 0 <= value <= 1:
        raise ValueError(f"scene.{name} must be in [0, 1], got {value}")
