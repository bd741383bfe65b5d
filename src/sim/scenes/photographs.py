"""Clean clips: photographs in smooth planar motion behind moving cut-outs of other photographs, as
E2VID was trained with (Rebecq et al. 2019; ESIM's multi-object renderer, Rebecq et al. 2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from src.sim import noise
from src.sim.scenes.clip import Clip, SceneBase
from src.sim.scenes.moving_layers import (
    MovingLayer,
    SimilarityMotion,
    blur_for_sampling,
    draw_motion_times_s,
    random_outline_mask,
    render_frame,
)
from src.sim.scenes.photo_files import (
    Photograph,
    Root,
    decode_photograph,
    list_photographs,
    list_roots,
    list_train_only_photographs,
    name_roots,
    name_source,
)

REFERENCE_WIDTH = 256  # of the frame that `photo_px_per_px` speaks of
CUTOUT_SIDE = 192  # of a cut-out's texture


@dataclass(kw_only=True, eq=False)
class PhotographScene(SceneBase):
    """What scenes of photographs share.

    `root`: a folder of photographs, searched recursively, a pack of them (scripts/pack_scenes.py),
    or several of either (None: those inside scikit-image); 10 % of each serve `val` and 20 %
    `test`.  `extra_train_root`: as `root`, more photographs, which serve training only.
    `photo_px_per_px`: range of photograph pixels per pixel of a frame 256 wide.
    `paused_clip_share`: of the clips in which all pauses, stops or never moves.  Raises ValueError
    where there are no photographs, or for a value outside its range.
    """

    root: Root = field(default=None, kw_only=False)
    extra_train_root: Root = None
    photo_px_per_px: Sequence[float] = (0.9, 1.6)
    paused_clip_share: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.photos = list_photographs(self.root, self.split)
        roots = list_roots("root", self.root)
        if self.split == "train":
            self.photos += list_train_only_photographs(self.extra_train_root, self.root)
            roots += list_roots("extra_train_root", self.extra_train_root)
        self._root_names = name_roots(roots)

    def background_layer(
        self, photo: NDArray, rng: np.random.Generator, speed_widths_per_s: Sequence[float]
    ) -> MovingLayer:
        """Return the layer behind all others: a photograph about its middle."""
        low, high = self.photo_px_per_px
        zoom = rng.uniform(low, high) * REFERENCE_WIDTH / self.width
        centre = rng.uniform(0.35, 0.65, 2) * photo.shape[::-1]
        motion = SimilarityMotion(rng, speed_widths_per_s)
        return MovingLayer(blur_for_sampling(photo, zoom), None, centre, zoom, motion)

    def read_random_photograph(self, rng: np.random.Generator) -> tuple[Photograph, NDArray]:
        """Return a photograph and its pixels, uint8 (h, w)."""
        photo = self.photos[rng.integers(len(self.photos))]
        return photo, decode_photograph(photo)

    def name_source(self, photo: Photograph) -> str:
        """Return what sets a photograph apart from all others of the scene."""
        return name_source(photo, self._root_names)

    def motion_times_s(self, rests: bool, rng: np.random.Generator) -> list[float]:
        """Return how long the clip has moved at every frame, with rests or without."""
        return (draw_motion_times_s(rng, self.times_s) if rests else self.times_s).tolist()


@dataclass(kw_only=True, eq=False)
class Photographs(PhotographScene):
    """Endless clips of photographs in motion.

    `speed_widths_per_s`: range of the speed, see `SimilarityMotion`; `max_cutouts`: most foreground
    objects, `cutout_widths` the range of their sides in frame widths; `cutouts_reenter`: they turn
    about their own middle and come in again opposite where they left.  `static_camera_share`: of
    the clips in which only they move.
    """

    speed_widths_per_s: Sequence[float] = (0.1, 1.5)
    max_cutouts: int = 3
    cutout_widths: Sequence[float] = (0.15, 0.5)
    cutouts_reenter: bool = False
    static_camera_share: float = 0.0

    def clip(self, index: int) -> Clip:
        key = noise.key(self.seed, self.split, "photographs", index)
        rng = np.random.default_rng(key)
        rng_rests = np.random.default_rng(noise.key(key, "tempo"))  # `rng` draws as without rests
        shares = self.static_camera_share, self.paused_clip_share
        static, rests = (rng_rests.uniform(size=2) < shares).tolist()
        photo, pixels = self.read_random_photograph(rng)
        layers = [self.background_layer(pixels, rng, self.speed_widths_per_s)]
        if static:
            layers[0].motion.stop()
        objects = max(int(rng.integers(self.max_cutouts + 1)), int(static and self.max_cutouts > 0))
        layers += [self._cutout_layer(rng) for _ in range(objects)]
        gain, offset = rng.uniform(0.75, 1.0), rng.uniform(-0.1, 0.1)
        times = self.motion_times_s(rests, rng_rests)
        frames = np.stack([render_frame(layers, time, self.size) for time in times])
        frames = np.clip(0.5 + offset + gain * (frames - 0.5), 0, 1).astype(np.float32)
        name, source = f"{photo.stem}-{index}", self.name_source(photo)
        return Clip(torch.from_numpy(frames), self.fps, name, source=source)

    def _cutout_layer(self, rng: np.random.Generator) -> MovingLayer:
        _, photo = self.read_random_photograph(rng)
        top, left = (rng.integers(max(1, n - CUTOUT_SIDE)) for n in photo.shape)
        texture = photo[top : top + CUTOUT_SIDE, left : left + CUTOUT_SIDE]
        low, high = self.cutout_widths
        zoom = max(texture.shape) / (rng.uniform(low, high) * self.width)
        mask = blur_for_sampling(random_outline_mask(texture.shape, rng), zoom)
        # Where the cut-out stands at t = 0, as seen from its own middle.
        place = rng.uniform(-0.5, 0.5, 2) * self.size[::-1]
        centre = np.array(texture.shape[::-1]) / 2 - place * zoom
        motion = SimilarityMotion(rng, self.speed_widths_per_s)
        picture = blur_for_sampling(texture, zoom)
        return MovingLayer(picture, mask, centre, zoom, motion, self.cutouts_reenter)
