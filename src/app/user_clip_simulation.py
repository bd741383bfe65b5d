"""The user's clip through turbulence, optics and sensor, some frames at a time."""

import math
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import DictConfig, open_dict
from torch import Tensor

from src.app.instantiate import build_part
from src.app.simulation import build_sensor, check_noise_rates, decodes_srgb
from src.recordings.simulated_recording import Progress, no_progress
from src.records.overrides import read_override_key
from src.sim import noise
from src.sim.optics import Optics
from src.sim.scenes import user_clip
from src.sim.scenes.user_clip import UserClip
from src.sim.sensor.response import decode_srgb, encode_srgb
from src.sim.sensor.sensor import EventSensor
from src.sim.turbulence.contract import ClipTurbulence, describe_clip_turbulence
from src.sim.turbulence.operator import Turbulence

PART_BYTES = 1 << 27  # of all views at a time
CLIP_FREE_BYTES = 1 << 28  # that are left on the disk
KEYS_OF_SCENES = ("scene", "data", "bins", "split")


@dataclass(frozen=True)
class SimulatedPart:
    """Those of the clip's own frames that a part of the simulated ones holds: `clean` (n, h, w) and
    `views` (views, n, h, w) in [0, 1], code values; `tilt` (views, n, 2, h, w), pixels.
    """

    clean: Tensor
    views: Tensor
    tilt: Tensor


class UserClipSimulation:
    """What the config `cfg` makes of `clip`: turbulence and sensor are drawn from its seed.

    `substeps`: simulated frames per frame of the clip.  Raises ValueError for values outside their
    range.
    """

    def __init__(self, cfg: DictConfig, clip: UserClip):
        least = cfg.least_simulated_fps
        if not 0 < least <= 1e5:
            raise ValueError(f"least_simulated_fps must be in (0, 1e5], got {least}")
        self.cfg, self.clip = cfg, clip
        self.substeps = max(1, math.ceil(round(least / clip.fps, 6)))
        self.optics: Optics = build_part(cfg, "optics")
        self.key = noise.key(cfg.seed, "own material", cfg.index)
        sensor = build_sensor(cfg, cfg.seed)
        check_noise_rates(sensor, self.simulated_fps)
        self.sensor: Any = sensor.draw(self.key)

    @property
    def simulated_fps(self) -> float:
        return self.clip.fps * self.substeps

    @property
    def simulated_frame_count(self) -> int:
        return (len(self.clip.frames) - 1) * self.substeps + 1

    @cached_property
    def turbulence(self) -> ClipTurbulence:
        model = build_part(self.cfg, "turbulence")
        drawn = model.draw(noise.generator(noise.key(self.key, "atmosphere")))
        height, width = self.clip.size
        size = {"height": height, "width": width}
        return model.operator(drawn, views=self.optics.positions, fps=self.simulated_fps, **size)

    def drawn_parameters(self) -> dict[str, Any]:
        """Return what was drawn."""
        own = {"name": self.clip.name, "threshold": self.sensor.threshold}
        generator = noise.generator(noise.key(self.key, "turbulence"))
        drawn = describe_clip_turbulence(self.turbulence, generator)
        return own | {"simulated_fps": self.simulated_fps} | drawn

    def describe(self) -> str:
        """Return size, rate, frames, turbulence and threshold in one line."""
        (height, width), drawn, fps = self.clip.size, self.drawn_parameters(), self.simulated_fps
        views = "one view" if self.optics.views == 1 else f"{self.optics.views} views"
        light = "decoded from sRGB" if decodes_srgb(self.cfg) else "taken as intensity"
        return (
            f"{self.clip.name}: {self.clip.source}; simulated as {views} of "
            f"{width}x{height} px at {fps:.6g} frames/s; turbulence {drawn['severity']}"
            f"{describe_turbulence(drawn)}; code values {light}, contrast threshold "
            f"{self.sensor.threshold:.3f}"
        )

    def simulate_parts(
        self, views: Float[Tensor, "views frames h w"], progress: Progress[int] = no_progress
    ) -> Iterator[SimulatedPart]:
        """Yield the clip part by part, and write what all views see, light, to `views`."""
        count = self.simulated_frame_count
        starts = range(0, count, max(1, PART_BYTES // (4 * views[:, 0].numel())))
        spans = [(first, min(first + starts.step, count)) for first in starts]
        blended = (self.clip.interpolate_frames(*span, self.substeps) for span in spans)
        is_srgb = decodes_srgb(self.cfg)
        seen = self._see(map(decode_srgb, blended) if is_srgb else blended)
        for number in progress(range(len(spans)), "turbulence"):
            (first, stop), (lights, tilt) = spans[number], next(seen)
            views[:, first:stop] = lights
            own = slice(-first % self.substeps, None, self.substeps)
            codes = encode_srgb(lights[:, own]) if is_srgb else lights[:, own]
            yield SimulatedPart(
                self.clip.interpolate_frames(first, stop, self.substeps)[own], codes, tilt[:, own]
            )

    def _see(self, parts: Iterable[Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield what all views see of each part, and its tilt; classes that know the contract only
        are asked for all frames at once.
        """
        operator, key = self.turbulence, noise.key(self.key, "turbulence")
        count = self.simulated_frame_count
        if isinstance(operator, Turbulence):
            yield from operator.degrade_parts(parts, count, noise.generator(key))
            return
        clean = list(parts)
        views = operator.degrade(torch.cat(clean)[None], noise.generator(key))[0]
        tilt = operator.tilt(count, noise.generator(key))
        sizes = [len(part) for part in clean]
        yield from zip(views.split(sizes, 1), tilt.split(sizes, 1), strict=True)

    def allocate_views(self, folder: Path) -> Float[Tensor, "views frames h w"]:
        """Return float16 memory for all views, in a file of `folder` that vanishes when it is no
        longer used.  Raises ValueError where the disk has no room for it and for what comes.
        """
        shape = (self.optics.views, self.simulated_frame_count, *self.clip.size)
        needed = 2 * math.prod(shape) + CLIP_FREE_BYTES
        needed += 2 * math.prod(shape) // self.substeps  # of the truth, at most about
        free = shutil.disk_usage(folder).free
        if free < needed:
            much = f"{needed >> 20} MiB free in {folder}, got {free >> 20} MiB"
            less = "a shorter part (end_s) or a smaller picture (longest_side_px) needs less"
            raise ValueError(f"write must have {much}; {less}")
        with tempfile.TemporaryFile(dir=folder) as file:
            return torch.from_numpy(np.memmap(file, np.float16, "w+", shape=shape))


def describe_turbulence(drawn: Mapping[str, Any]) -> str:
    """Return how far turbulence moves and spreads a point of the clip, pixels, along one axis."""
    if not (tilt := drawn.get("tilt_px")):
        return ""
    return f": tilt {tilt:.2f} px, blur {drawn.get('blur_px', 0.0):.2f} px rms"


def refuse_keys_of_scenes(overrides: Iterable[str]) -> None:
    """Raise ValueError for an override that a video or photograph does not follow from."""
    for key in map(read_override_key, overrides):
        if key.partition(".")[0] in KEYS_OF_SCENES:
            wrong = "must not be given with a video or photograph: it is of clips of a scene"
            raise ValueError(f"{key} {wrong}")


def set_user_clip_sensor(cfg: DictConfig, overrides: Iterable[str]) -> None:
    """Give `sensor` the values of `user_clip_sensor`, as photographs and films need them, but for
    the keys that `overrides`, such as sensor.threshold=0.3, set; those go to `user_clip_sensor`, so
    that the stored config gives the same clip.  Neither kind is drawn at random.
    """
    given = set(map(read_override_key, overrides))
    wanted = cfg.user_clip_sensor or {}
    for key in wanted.keys() & cfg.sensor.keys():
        if f"sensor.{key}" in given:
            wanted[key] = cfg.sensor[key]
        else:
            cfg.sensor[key] = wanted[key]
            _check_user_clip_sensor(key, wanted[key])
    fixed = {*wanted} | {name.removeprefix("sensor.") for name in given}
    with open_dict(cfg):
        for name in [*(cfg.sensor.get("random") or {})]:
            if name in fixed and f"sensor.random.{name}" not in given:
                del cfg.sensor.random[name]


def _check_user_clip_sensor(key: str, value: Any) -> None:
    """Raise ValueError, which names `user_clip_sensor`, for a value that an EventSensor refuses."""
    if key in {one.name for one in fields(EventSensor)}:
        try:
            EventSensor(**{key: value})
        except ValueError as error:
            raise ValueError(f"user_clip_{error}") from None


def read_user_clip(cfg: DictConfig) -> UserClip:
    """Return the clip that `video` or `photo` names; ValueError for both and for wrong values."""
    if cfg.video and cfg.photo:
        raise ValueError(f"video must be null with photo={cfg.photo}, got {cfg.video}")
    options = {key: cfg[key] for key in ("fps", "longest_side_px", "white_level")}
    if cfg.video:
        user_clip.refuse_motion_of_video(cfg.seconds, cfg.speed_widths_per_s)
        return user_clip.read_video(cfg.video, start_s=cfg.start_s, end_s=cfg.end_s, **options)
    user_clip.refuse_part_of_photograph(cfg.start_s, cfg.end_s)
    motion = {"speed_widths_per_s": cfg.speed_widths_per_s, "seed": cfg.seed}
    return user_clip.read_photograph(cfg.photo, seconds=cfg.seconds, **motion, **options)
