"""Clips from footage: REDS as it is distributed, any video file, any folder of frames.

The middle of the picture is cut out in the frame's proportions and shrunk with an area filter;
between two frames of the footage lies their linear blend.  Grey values are luminance code values.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from src.sim.scenes.clip import Clip, SceneBase
from src.sim.scenes.code_values import ALL_BITS, scale_to_white, warn_of_darkness
from src.sim.scenes.video_files import VideoSource, find_videos

SHARES = {"train": (0.0, 0.7), "val": (0.7, 0.8), "test": (0.8, 1.0)}

REDS_FPS = 120.0
REDS_FRAMES = 481  # over 4 s, what the paper uses of each sequence's 500
REDS_SIZE = (720, 1280)
# The paper splits the 270 sequences 216/27/27 and does not say which; the test is wholly from the
# official validation part.
REDS_SPLIT = {
    "train": [("train", number) for number in range(216)],
    "val": [("train", number) for number in range(216, 240)] + [("val", n) for n in range(3)],
    "test": [("val", number) for number in range(3, 30)],
}

Segment = tuple[VideoSource, int]  # a video and the frame where a clip starts


@dataclass(kw_only=True, eq=False)
class Footage(SceneBase):
    """A video file, a folder of frames, or a folder of either, at `root`.

    `footage_fps`: frames per second that the footage is taken for, whatever the file says.
    `white_level`: value of a frame's file that is white (None: the largest its kind holds).
    `disjoint_splits`: train, val and test get 70, 10 and 20 % of it, by whole videos from ten
    videos on, else by time; otherwise all share everything.  Raises ValueError where `root` is
    missing, holds no footage, cannot be read or is too short for a clip.
    """

    root: str | None = field(default=None, kw_only=False)
    footage_fps: float = 120.0
    disjoint_splits: bool = True
    white_level: float | None = None
    min_footage_px_per_px: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.footage_fps < math.inf:
            raise ValueError(f"scene.footage_fps must be > 0, got {self.footage_fps}")
        if self.root is None or not Path(self.root).exists():
            raise ValueError(f"scene.root must be footage that exists, got {self.root}")
        # When the frames are, in frames of the footage, and how many of its intervals pass.
        self.times = np.round(np.arange(self.frames) * self.footage_fps / self.fps, 6)
        self.segments = self._find_segments(Path(self.root), math.ceil(self.times[-1]))

    def clip(self, index: int) -> Clip:
        """Return segment `index` modulo their number; ValueError for frames that do not do."""
        source, start = self.segments[index % len(self.segments)]
        last = math.ceil(self.times[-1])
        pictures = list(source.read(start, start + last + 1, ALL_BITS))
        seen = np.stack([self._fit(picture) for picture in pictures])
        largest = max(float(picture.max()) for picture in pictures)
        key = "scene.white_level"
        warn_of_darkness(source.name, pictures[0].dtype, largest, self.white_level, key)
        before = np.floor(self.times).astype(int)
        share = (self.times - before).astype(np.float32)[:, None, None]
        frames = seen[before] + share * (seen[np.minimum(before + 1, last)] - seen[before])
        return Clip(
            torch.from_numpy(frames), self.fps, f"{source.name}-{start}", source=source.name
        )

    def _find_segments(self, root: Path, span: int) -> list[Segment]:
        """Return where clips start: first the first of every video, then the second, and so on."""
        low, high = SHARES[self.split] if self.disjoint_splits else (0.0, 1.0)
        videos = find_videos(root)
        if len(videos) >= 10:
            videos = videos[int(low * len(videos)) : int(high * len(videos))]
            low, high = 0.0, 1.0
        parts = [(int(low * one.count), int(high * one.count)) for one in videos]
        starts = [
            (turn, place, first + turn)
            for place, (first, stop) in enumerate(parts)
            for turn in range(0, stop - first - span, max(span, 1))
        ]
        if not starts:
            longest = max(stop - first for first, stop in parts)
            raise ValueError(
                f"scene.root must show {span + 1} frames on end for split={self.split} (scene."
                f"disjoint_splits=false: all splits share the footage), got {longest} in {root}"
            )
        return [(videos[place], start) for _, place, start in sorted(starts)]

    def _fit(self, picture: NDArray) -> NDArray[np.float32]:
        """Return the middle of a picture, (h, w) in [0, 1], as much of it as fits; raises
        ValueError where a pixel would be less than `min_footage_px_per_px` of the picture's.
        """
        (tall, wide), (height, width), least = picture.shape, self.size, self.min_footage_px_per_px
        scale = min(tall / height, wide / width)
        if scale < least:
            sides = f"{math.ceil(width * least)}x{math.ceil(height * least)} px or more"
            sides += " (for scene.width and scene.height)"
            raise ValueError(f"scene.root must show {sides}, got {wide}x{tall}")
        rows, columns = round(height * scale), round(width * scale)
        top, left = (tall - rows) // 2, (wide - columns) // 2
        middle = picture[top : top + rows, left : left + columns]
        middle = scale_to_white(middle, self.white_level, "scene.white_level")
        kind = cv2.INTER_AREA if scale >= 1 else cv2.INTER_CUBIC
        return np.clip(cv2.resize(middle, (width, height), interpolation=kind), 0, 1)


@dataclass(kw_only=True, eq=False)
class Reds(Footage):
    """REDS at 120 fps (Nah et al. 2019): `root` holds the folders train_orig/000 .. 239 and
    val_orig/000 .. 029 (also inside train/ and val/) with frames 00000000.png .. of 1280x720.

    Clip `index` shows sequence `index` modulo their number; each round shows the next stretch of
    the first 4 s.  Raises ValueError where sequences of the split are missing.
    """

    footage_fps: float = field(default=REDS_FPS, init=False)
    disjoint_splits: bool = field(default=True, init=False)
    white_level: float | None = field(default=None, init=False)
    min_footage_px_per_px: ClassVar[float] = 0.5

    def _find_segments(self, root: Path, span: int) -> list[Segment]:
        if span >= REDS_FRAMES:
            raise ValueError(f"a clip of REDS must last at most 4 s, got {span / REDS_FPS:.3f}")
        videos = [self._sequence(root, *place) for place in REDS_SPLIT[self.split]]
        starts = range(0, REDS_FRAMES - span, max(span, 1))
        return [(video, start) for start in starts for video in videos]

    def _sequence(self, root: Path, part: str, number: int) -> VideoSource:
        homes = (root / f"{part}_orig", root / part / f"{part}_orig")
        folder = next((h / f"{number:03}" for h in homes if (h / f"{number:03}").is_dir()), None)
        if folder is None:
            raise ValueError(
                f"scene.root must hold all {len(REDS_SPLIT[self.split])} sequences of split="
                f"{self.split}, got no {part}_orig/{number:03} in {root}"
            )
        frames = tuple(folder / f"{frame:08}.png" for frame in range(REDS_FRAMES))
        name = f"{part}-{number:03}"
        return VideoSource(name, REDS_FRAMES, "scene.root", frames=frames, size=REDS_SIZE)
