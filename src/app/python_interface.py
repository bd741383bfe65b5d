"""The simulation for code of your own: `simulate("my.mp4", turbulence="strong", views=9)`."""

import math
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from src.app.compose import compose_checked_config
from src.app.config_files import config_choices
from src.app.user_clip_simulation import (
    UserClipSimulation,
    read_user_clip,
    refuse_keys_of_scenes,
    set_user_clip_sensor,
)
from src.recordings.files.event_arrays import concatenate_events, sort_events
from src.recordings.files.event_file import EVENT
from src.records.overrides import read_override_key
from src.sim.optics import Position, view_id
from src.sim.scenes import user_clip
from src.sim.scenes.video_files import is_photograph

VIEW_EVENT = np.dtype([*EVENT.descr, ("view", np.uint16)])
ARGUMENTS = (
    "turbulence", "sensor", "fps", "seconds", "start_s", "end_s", "longest_side_px", "seed",
)  # fmt: skip
NO_OVERRIDES = {key: f"it is the argument {key}" for key in ARGUMENTS}
NO_OVERRIDES |= {"optics.views": "it is the argument views"}
NO_OVERRIDES |= dict.fromkeys(("photo", "video"), "it is the argument photo_or_video")
OF_THE_COMMAND_LINE = ("write", "like", "large", "camera", "name", "task", "paths", "hydra")


@dataclass(frozen=True, eq=False)
class SimulatedClip:
    """A clip seen through turbulence; it unpacks into clean, views, tilt and events.

    `clean` (frames, h, w) and `views` (views, frames, h, w): float32 in [0, 1], grey code values.
    `tilt` (views, frames, 2, h, w): float32, displacement (x, y) in pixels.  `events` (n,), in
    order of time: t in us from the first frame on (int64), x, y in pixels of the view (uint16),
    p -1 or 1 (int8), view, an index into `positions` (uint16).  `fps`: frames a second;
    `positions`: (row, col) of each view from the centre view.

    `drawn`: what was drawn, among it `threshold` (contrast, nat), `simulated_fps` (frames a
    second), `severity` (a word), `d_over_r0` (D/r0), `tilt_px`, `blur_px` (beyond diffraction) and
    `tilt_and_blur_px` (rms along an axis, pixels of the clip), `tilt_correlation_half_length_px`,
    `tilt_correlation_time_s` (to 1/e), `temporal_model` and its `wind_m_s` (rms, 0 of ar1); of
    turbulence=recorded what it names.
    """

    clean: Float[np.ndarray, "frames h w"]
    views: Float[np.ndarray, "views frames h w"]
    tilt: Float[np.ndarray, "views frames 2 h w"]
    events: np.ndarray
    fps: float
    positions: Sequence[Position]
    drawn: dict[str, Any]

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.clean, self.views, self.tilt, self.events))


def simulate(
    photo_or_video: Any, turbulence: str = "strong", views: int = 9, *, sensor: str = "paper",
    fps: float | None = None, seconds: float | None = None, start_s: float = 0.0,
    end_s: float = math.inf, longest_side_px: int | None = None, seed: int = 0,
    overrides: Sequence[str] = (),
) -> SimulatedClip:  # fmt: skip
    """Return what a light field of `views` views and an event sensor see of your material.

    `photo_or_video`: a path, of a picture, a video or a folder of frames, or an array, (h, w) or
    (frames, h, w), uint8 or floats in [0, 1].  `turbulence`: none, weak, medium, strong, extreme,
    mixed, or of footage: measured and recorded, which need `overrides` such as
    turbulence.measured=air.yaml and turbulence.footage=site.mp4.  `sensor`: a name of conf/sensor,
    such as paper, ideal, noisy or evk4; code values are taken as sRGB and the contrast threshold is
    0.2 with any, unless `overrides` set sensor.input and sensor.threshold.

    `fps`: frames a second; None: those of the file, 120 for a photograph.  `seconds`: the length of
    a photograph (None: 1).  `start_s`, `end_s`: the part of a video, in seconds.
    `longest_side_px`: of the frames, 16 or more (None: their own, at most 512).  `overrides`: other
    keys of conf/simulate.yaml, written as on the command line.

    The result is a function of the arguments.  Raises ValueError for values outside their range,
    for `seconds` of a video and a part of a photograph, and for overrides that are none, are
    arguments, or have no effect here (of `scene`, or of the command line alone).
    """
    overrides = _read_overrides(overrides)
    _refuse_other_overrides(overrides)
    if not isinstance(seed, int | np.integer):
        raise ValueError(f"seed must be a whole number, got {seed}")
    for group, choice in (("turbulence", turbulence), ("sensor", sensor)):
        if choice not in (names := config_choices(group)):
            raise ValueError(f"{group} must be one of {', '.join(names)}, got {choice}")
    chosen = [f"turbulence={turbulence}", f"optics.views={views}", f"sensor={sensor}"]
    cfg = compose_checked_config("simulate", [*chosen, f"seed={seed}"], overrides)
    set_user_clip_sensor(cfg, overrides)
    options: dict[str, Any] = {"fps": fps, "seconds": seconds, "longest_side_px": longest_side_px}
    options |= {"start_s": start_s, "end_s": end_s}
    options = {
        key: one.item() if isinstance(one, np.generic) else one for key, one in options.items()
    }
    for key, one in options.items():
        if not (one is None or isinstance(one, Real)):
            raise ValueError(f"{key} must be a number, got {one!r}")
    if isinstance(photo_or_video, str | Path):
        path = Path(photo_or_video)
        key = "photo" if is_photograph(path) else "video"
        cfg.update(options | {key: str(path)})
        clip = read_user_clip(cfg)
    else:
        options |= {"speed_widths_per_s": cfg.speed_widths_per_s, "seed": cfg.seed}
        clip = user_clip.clip_from_array(photo_or_video, white_level=cfg.white_level, **options)
    return simulate_clip(UserClipSimulation(cfg, clip))


def _read_overrides(overrides: Any) -> list[str]:
    """Return the overrides; ValueError unless they are a list of key=value."""
    if isinstance(overrides, str):
        raise ValueError(f"overrides must be a list of words, as in [{overrides!r}], got a str")
    if isinstance(overrides, Mapping) or not isinstance(overrides, Iterable):
        wanted = "overrides must be a list of key=value, as in ['sensor.threshold=0.3']"
        raise ValueError(f"{wanted}, got {overrides!r}")
    words = list(overrides)
    for word in words:
        if not (isinstance(word, str) and ("=" in word or word.startswith("~"))):
            raise ValueError(f"overrides must each be key=value, got {word!r}")
    return words


def _refuse_other_overrides(overrides: Sequence[str]) -> None:
    for key in map(read_override_key, overrides):
        if key in NO_OVERRIDES:
            raise ValueError(f"overrides must not set {key}: {NO_OVERRIDES[key]}")
        if key.replace("/", ".").partition(".")[0] in OF_THE_COMMAND_LINE:
            raise ValueError(f"overrides must not set {key}: it is of the command line alone")
    refuse_keys_of_scenes(overrides)


def simulate_clip(work: UserClipSimulation) -> SimulatedClip:
    """Return all that `work` makes."""
    clip, count, shape = work.clip, len(work.clip.frames), work.clip.size
    clean = np.empty((count, *shape), np.float32)
    views = np.empty((work.optics.views, count, *shape), np.float32)
    tilt = np.empty((work.optics.views, count, 2, *shape), np.float32)
    seen, first = work.allocate_views(Path(tempfile.gettempdir())), 0
    for part in work.simulate_parts(seen):
        at = slice(first, first + len(part.clean))
        clean[at], views[:, at], tilt[:, at] = part.clean, part.views, part.tilt
        first = at.stop
    events, positions = simulate_all_view_events(work, seen), work.optics.positions
    if not len(events):
        more = "a lower sensor.threshold, longer seconds or stronger turbulence give some"
        warnings.warn(f"the clip gives no events; {more}", stacklevel=3)
    return SimulatedClip(clean, views, tilt, events, clip.fps, positions, work.drawn_parameters())


def simulate_all_view_events(
    work: UserClipSimulation, views: Float[Tensor, "views frames h w"]
) -> np.ndarray:
    """Return the events of all views in order of time."""
    parts = []
    for index, position in enumerate(work.optics.positions):
        light, place = views[index].float(), {"clip": work.key, "view": view_id(position)}
        own = work.sensor.events(light, work.simulated_fps, **place)
        parts.append(np.empty(len(own), VIEW_EVENT))
        parts[-1][[*"txyp"]], parts[-1]["view"] = own[[*"txyp"]], index
    return sort_events(concatenate_events(parts))
