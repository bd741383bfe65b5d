"""Clean clips: photographs in smooth planar motion behind moving cut-outs of other photographs.

The recipe E2VID was trained with (Rebecq et al. 2019; ESIM's multi-object renderer, Rebecq et al.
2018), as a function of time in seconds: the same clip at k times the frame rate holds the same
frames with k - 1 more between any two.  Known-motion targets: targets.py; REDS and videos:
footage.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from src.sim import noise
from src.sim.scenes.motion import Motion, Tempo
from src.sim.scenes.pictures import read_picture

SPLITS = ("train", "val", "test")
SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff"}
LARGEST_SIDE = 1024  # of a photograph in memory
REFERENCE_WIDTH = 256  # of the frame that `zoom` speaks of
CUTOUT_SIDE = 192  # of a cut-out's texture

# The photographs inside the scikit-image wheel; no split shares one with another, each has scenes
# and textures.
EMBEDDED = {
    "train": "astronaut brick camera coffee grass hubble_deep_field moon motorcycle_left retina",
    "val": "coins",
    "test": "chelsea gravel rocket",
}


@dataclass(frozen=True)
class Clip:
    """`frames` (frames, h, w) float32 in [0, 1], code values; `truth`: the path (frames, 2) of a
    known target's centre (x, y) in pixels, where there is one.
    """

    frames: Float[Tensor, "frames h w"]
    fps: float
    name: str
    truth: Float[Tensor, "frames 2"] | None = None


class Photographs:
    """Endless clips of photographs in motion.

    `root`: a folder of photographs, searched recursively, or several (None: those inside
    scikit-image); 10 % of each serve `val` and 20 % `test`.  `speed`: range of the drift, in frame
    widths per second; `zoom`: range of photograph pixels per pixel of a frame 256 wide; `cutouts`:
    most foreground objects.  `still`: probability that only these move; `rest`: that all pauses,
    stops or never moves.  Raises ValueError where there are no photographs, or for a value outside
    its range.
    """

    def __init__(
        self,
        root: str | Sequence[str] | None = None,
        *,
        split: str = "train",
        seed: int = 0,
        height: int = 256,
        width: int = 256,
        frames: int = 41,
        fps: float = 120.0,
        speed: Sequence[float] = (0.1, 1.5),
        zoom: Sequence[float] = (0.9, 1.6),
        cutouts: int = 3,
        still: float = 0.0,
        rest: float = 0.0,
    ):
        check_frames(height, width, frames, fps, split)
        for name, (low, high) in (("speed", speed), ("zoom", zoom)):
            if not 0 < low <= high < math.inf:
                raise ValueError(f"scene.{name} must be a range 0 < low <= high, got {low}, {high}")
        if cutouts < 0:
            raise ValueError(f"scene.cutouts must be >= 0, got {cutouts}")
        for name, value in (("still", still), ("rest", rest)):
            if not 0 <= value <= 1:
                raise ValueError(f"scene.{name} must be in [0, 1], got {value}")
        self.photos = photographs(root, split)
        self.split, self.seed, self.size = split, seed, (height, width)
        self.times = np.arange(frames) / fps
        self.fps, self.speed, self.zoom, self.cutouts = fps, speed, zoom, cutouts
        self.still, self.rest = still, rest

    def clip(self, index: int) -> Clip:
        """Return clip `index`: a function of the seed, the split and the index."""
        key = noise.key(self.seed, self.split, "photographs", index)
        rng = np.random.default_rng(key)
        apart = np.random.default_rng(noise.key(key, "tempo"))  # `rng` draws as it did without
        still, rests = apart.uniform(size=2) < (self.still, self.rest)
        name, background = self._photo(rng)
        layers = [self._background(background, rng)]
        if still:
            layers[0].motion.stop()
        objects = max(rng.integers(self.cutouts + 1), int(still and self.cutouts > 0))
        layers += [self._cutout(rng) for _ in range(objects)]
        gain, offset = rng.uniform(0.75, 1.0), rng.uniform(-0.1, 0.1)
        times = map(Tempo(apart), self.times) if rests else self.times
        frames = np.stack([self._render(layers, time) for time in times])
        frames = np.clip(0.5 + offset + gain * (frames - 0.5), 0, 1).astype(np.float32)
        return Clip(torch.from_numpy(frames), self.fps, f"{name}-{index}")

    def _photo(self, rng: np.random.Generator) -> tuple[str, NDArray]:
        path = self.photos[rng.integers(len(self.photos))]
        return path.stem, _read(path)

    def _background(self, photo: NDArray, rng: np.random.Generator) -> "_Layer":
        zoom = rng.uniform(*self.zoom) * REFERENCE_WIDTH / self.size[1]
        centre = rng.uniform(0.35, 0.65, 2) * photo.shape[::-1]
        return _Layer(_smooth(photo, zoom), None, centre, zoom, Motion(rng, self.speed))

    def _cutout(self, rng: np.random.Generator) -> "_Layer":
        _, photo = self._photo(rng)
        top, left = (rng.integers(max(1, n - CUTOUT_SIDE)) for n in photo.shape)
        texture = photo[top : top + CUTOUT_SIDE, left : left + CUTOUT_SIDE]
        side = rng.uniform(0.15, 0.5)  # of the frame's width
        zoom = max(texture.shape) / (side * self.size[1])
        mask = _smooth(_blob(texture.shape, rng), zoom)
        # Where the cut-out stands at t = 0, as seen from its own middle.
        place = rng.uniform(-0.5, 0.5, 2) * self.size[::-1]
        centre = np.array(texture.shape[::-1]) / 2 - place * zoom
        return _Layer(_smooth(texture, zoom), mask, centre, zoom, Motion(rng, self.speed))

    def _render(self, layers: Sequence["_Layer"], time: float) -> NDArray:
        background, *cutouts = layers
        frame = _warp(background.picture, background.matrix(time, self.size), self.size)
        for layer in cutouts:
            matrix = layer.matrix(time, self.size)
            rows, columns = _seen(layer.mask.shape, matrix, self.size)
            behind = frame[rows, columns]
            if behind.size:
                matrix[:, 2] += matrix[:, :2] @ (columns.start, rows.start)
                alpha = _warp(layer.mask, matrix, behind.shape, cv2.BORDER_CONSTANT)
                behind += alpha * (_warp(layer.picture, matrix, behind.shape) - behind)
        return frame


@dataclass(frozen=True)
class _Layer:
    picture: NDArray
    mask: NDArray | None
    centre: NDArray  # the point of the picture in the middle of the frame at t = 0
    zoom: float  # picture pixels per frame pixel
    motion: Motion

    def matrix(self, time: float, size: tuple[int, int]) -> NDArray:
        """Return the 2x3 map from frame pixels to picture pixels."""
        height, width = size
        shift, angle, log_zoom = self.motion.at(time)
        scale = self.zoom * math.exp(log_zoom)
        cos, sin = math.cos(angle), math.sin(angle)
        turn = scale * np.array([[cos, -sin], [sin, cos]])
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        offset = self.centre - shift * width * self.zoom - turn @ middle
        return np.column_stack([turn, offset])


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
    _check_split(split)
    for name, value, least in (("height", height, 8), ("width", width, 8), ("frames", frames, 2)):
        if value < least:
            raise ValueError(f"scene.{name} must be >= {least}, got {value}")
    if not 0 < fps < math.inf:
        raise ValueError(f"fps must be > 0, got {fps}")


def _check_split(split: str) -> None:
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split}")


def photographs(root: str | Sequence[str] | None, split: str) -> list[Path]:
    """Return the photographs of a split; of several folders, each one's own share of it.

    Raises ValueError where there are none, and for a split that is none.
    """
    _check_split(split)
    if isinstance(root, Sequence) and not isinstance(root, str):
        if not root:
            raise ValueError("scene.root must be a folder, or some, got an empty list")
        return [path for one in root for path in photographs(str(one), split)]
    if root is None:
        folder = Path(find_spec("skimage").origin).parent / "data"
        embedded = {path.stem: path for path in folder.iterdir() if path.suffix in SUFFIXES}
        return [embedded[name] for name in EMBEDDED[split].split()]
    if not Path(root).is_dir():
        raise ValueError(f"scene.root must be a folder, got {root}")
    paths = sorted(path for path in Path(root).rglob("*") if path.suffix.lower() in SUFFIXES)
    if len(paths) < 10:
        raise ValueError(
            f"scene.root must hold at least 10 photographs, got {len(paths)} in {root}"
        )
    share = {"train": (0, 1, 2, 3, 5, 6, 8), "val": (4,), "test": (7, 9)}[split]
    return [path for place, path in enumerate(paths) if place % 10 in share]


@lru_cache(maxsize=512)
def _read(path: Path) -> NDArray:
    """Return a photograph's luminance as uint8, at most LARGEST_SIDE long."""
    picture = read_picture(path)
    shrink = 1 if picture is None else min(1, LARGEST_SIDE / max(picture.shape))
    if picture is None or shrink * min(picture.shape) < 16:
        raise ValueError(f"scene.root must hold readable photographs of 16 px or more, got {path}")
    if shrink < 1:
        picture = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return picture


def _smooth(picture: NDArray, zoom: float) -> NDArray:
    """Return float32 in [0, 1], blurred for sampling every `zoom` pixels without aliasing.

    The blur also hides the interpolation: bilinear sampling between pixels of a sharp picture
    flickers as it moves, and a flicker makes events.
    """
    scale = 255 if picture.dtype == np.uint8 else 1
    return cv2.GaussianBlur(picture.astype(np.float32) / scale, (0, 0), max(0.6, 0.5 * zoom))


def _blob(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray:
    """Return a mask, 1 inside a random smooth outline that keeps off the picture's border."""
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    angle = np.arctan2(y, x)
    radius = rng.uniform(0.5, 0.7)
    for order in range(2, 7):
        swing = rng.uniform(0, 0.3) / order
        radius = radius + swing * np.cos(order * angle + rng.uniform(0, 2 * math.pi))
    inside = 32 * (np.minimum(radius, 0.92) - np.hypot(x, y))
    smooth = cv2.resize(inside.astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(smooth, 0, 1)


def _seen(shape: tuple[int, ...], matrix: NDArray, size: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of the frame that a picture of `shape` can touch."""
    height, width = shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - matrix[:, 2]
    x, y = np.linalg.solve(matrix[:, :2], corners.T)
    spans = ((y.min(), y.max(), size[0]), (x.min(), x.max(), size[1]))
    return tuple(
        slice(max(0, int(low) - 1), max(0, min(int(high) + 2, n))) for low, high, n in spans
    )


def _warp(
    picture: NDArray, matrix: NDArray, size: Sequence[int], border: int = cv2.BORDER_REFLECT_101
) -> NDArray:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, matrix, size[::-1], flags=flags, borderMode=border)
