"""Clips from footage: REDS as it is distributed, any video file, any folder of frames.

The middle of the picture is cut out in the frame's proportions and shrunk with an area filter.  A
clip is a function of time: its frame at time t is the footage at t, and between two frames of the
footage their linear blend, which adds no motion.  Grey values are luminance code values.
"""

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from src.sim.scenes.photographs import Clip, check_frames
from src.sim.scenes.videos import Source, pictures, sources

SHARES = {"train": (0.0, 0.7), "val": (0.7, 0.8), "test": (0.8, 1.0)}

REDS_FPS = 120.0
REDS_FRAMES = 480  # the 4 s of each sequence's 500 frames that the paper uses
REDS_SIZE = (720, 1280)
# The paper splits the 270 sequences 216/27/27 and does not say which; the test is wholly from the
# official validation part.
REDS_SPLIT = {
    "train": [("train", number) for number in range(216)],
    "val": [("train", number) for number in range(216, 240)] + [("val", n) for n in range(3)],
    "test": [("val", number) for number in range(3, 30)],
}


class Reds:
    """REDS at 120 fps (Nah et al. 2019): `root` holds the folders train_orig/000 .. 239 and
    val_orig/000 .. 029 (also inside train/ and val/) with frames 00000000.png .. of 1280x720.

    Clip `index` shows sequence `index` modulo their number; each round shows the next stretch of
    the first 4 s.  Raises ValueError where sequences of the split are missing.
    """

    def __init__(
        self,
        root: str | None,
        *,
        split: str = "train",
        seed: int = 0,
        height: int = 256,
        width: int = 256,
        frames: int = 41,
        fps: float = 120.0,
    ):
        check_frames(height, width, frames, fps, split)
        self.times, span = _times(frames, fps, REDS_FPS)
        if span >= REDS_FRAMES:
            raise ValueError(f"a clip of REDS must last at most 3.99 s, got {span / REDS_FPS:.2f}")
        self.sources = _reds(_root(root), split)
        self.starts = range(0, REDS_FRAMES - span, max(span, 1))
        self.fps, self.size = fps, (height, width)

    def clip(self, index: int) -> Clip:
        """Return clip `index`; raises ValueError for a missing frame or one of another size."""
        turn, place = divmod(index, len(self.sources))
        source, start = self.sources[place], self.starts[turn % len(self.starts)]
        frames = _play(source, start, self.times, self.size, least=0.5)
        return Clip(frames, self.fps, f"{source.name}-{start}")


class Footage:
    """A video file, a folder of frames, or a folder of either, at `root`.

    `rate`: frames per second that the footage is taken for, whatever the file says.  `shrink`:
    source pixels per pixel; None takes as many as fit, which makes motion per frame smallest.
    `disjoint`: train, val and test get 70, 10 and 20 % of it, by whole videos from ten videos on,
    else by time; otherwise all share everything.  Raises ValueError where `root` is missing, holds
    no footage, cannot be read or is too short for a clip.
    """

    def __init__(
        self,
        root: str | None,
        *,
        split: str = "train",
        seed: int = 0,
        height: int = 256,
        width: int = 256,
        frames: int = 41,
        fps: float = 120.0,
        rate: float = 120.0,
        shrink: float | None = None,
        disjoint: bool = True,
    ):
        check_frames(height, width, frames, fps, split)
        if not 0 < rate < math.inf:
            raise ValueError(f"scene.rate must be > 0, got {rate}")
        if shrink is not None and not 1 <= shrink < math.inf:
            raise ValueError(f"scene.shrink must be >= 1 or null, got {shrink}")
        self.fps, self.size, self.shrink = fps, (height, width), shrink
        self.times, span = _times(frames, fps, rate)
        parts = _parts(sources(_root(root)), split, disjoint)
        self.segments = _segments(parts, span)
        if not self.segments:
            longest = max(stop - first for _, first, stop in parts)
            raise ValueError(
                f"scene.root must show {span + 1} frames on end for split={split} (scene.disjoint="
                f"false lets all splits share the footage), got {longest} in {root}"
            )

    def clip(self, index: int) -> Clip:
        """Return segment `index` modulo their number; raises ValueError for frames too small."""
        source, start = self.segments[index % len(self.segments)]
        frames = _play(source, start, self.times, self.size, shrink=self.shrink)
        return Clip(frames, self.fps, f"{source.name}-{start}")


def _times(frames: int, fps: float, rate: float) -> tuple[NDArray, int]:
    """Return when the frames are, in frames of the footage, and how many of its intervals pass."""
    times = np.round(np.arange(frames) * rate / fps, 6)
    return times, math.ceil(times[-1])


def _play(source: Source, start: int, times: NDArray, size: tuple[int, int], **fit) -> Tensor:
    """Return (frames, h, w) at `times`, which count frames of the footage from `start`."""
    last = math.ceil(times[-1])
    shown = np.stack([_fit(p, size, **fit) for p in source.read(start, start + last + 1)])
    before = np.floor(times).astype(int)
    after = np.minimum(before + 1, last)
    share = (times - before).astype(np.float32)[:, None, None]
    return torch.from_numpy(shown[before] + share * (shown[after] - shown[before]))


def _fit(
    picture: NDArray, size: tuple[int, int], *, shrink: float | None = None, least: float = 1.0
) -> NDArray:
    """Return the middle of a picture as float32 (h, w) in [0, 1], `shrink` times smaller or as much
    as fits; raises ValueError where that would be less than `least`.
    """
    (tall, wide), (height, width) = picture.shape, size
    fits = min(tall / height, wide / width)
    need = shrink or least
    if fits < need:
        raise ValueError(
            f"scene.root must show {math.ceil(width * need)}x{math.ceil(height * need)} px or more "
            f"(scene.width and scene.height, times scene.shrink), got {wide}x{tall}"
        )
    scale = shrink or fits
    rows, columns = round(height * scale), round(width * scale)
    top, left = (tall - rows) // 2, (wide - columns) // 2
    middle = picture[top : top + rows, left : left + columns].astype(np.float32) / 255
    kind = cv2.INTER_AREA if scale >= 1 else cv2.INTER_CUBIC
    return np.clip(cv2.resize(middle, (width, height), interpolation=kind), 0, 1)


def _root(root: str | None) -> Path:
    if root is None or not Path(root).exists():
        raise ValueError(f"scene.root must be footage that exists, got {root}")
    return Path(root)


def _reds(root: Path, split: str) -> list[Source]:
    videos = []
    for part, number in REDS_SPLIT[split]:
        homes = (root / f"{part}_orig", root / part / f"{part}_orig")
        folders = [home / f"{number:03}" for home in homes]
        folder = next((folder for folder in folders if folder.is_dir()), None)
        if folder is None:
            raise ValueError(
                f"scene.root must hold all {len(REDS_SPLIT[split])} sequences of split={split}, "
                f"got no {part}_orig/{number:03} in {root}"
            )
        paths = [folder / f"{frame:08}.png" for frame in range(REDS_FRAMES)]
        videos.append(pictures(f"{part}-{number:03}", paths, REDS_SIZE))
    return videos


def _parts(videos: list[Source], split: str, disjoint: bool) -> list[tuple[Source, int, int]]:
    """Return the split's videos, each with its first frame and the one after its last."""
    low, high = SHARES[split] if disjoint else (0.0, 1.0)
    n = len(videos)
    if n >= 10:
        return [(video, 0, video.count) for video in videos[int(low * n) : int(high * n)]]
    return [(video, int(low * video.count), int(high * video.count)) for video in videos]


def _segments(parts: list[tuple[Source, int, int]], span: int) -> list[tuple[Source, int]]:
    """Return where clips start: first the first of every video, then the second, and so on."""
    starts = [
        (first + turn, place)
        for place, (_, first, stop) in enumerate(parts)
        for turn in range(0, stop - first - span, max(span, 1))
    ]
    turns = sorted(starts, key=lambda pair: (pair[0] - parts[pair[1]][1], pair[1]))
    return [(parts[place][0], start) for start, place in turns]
