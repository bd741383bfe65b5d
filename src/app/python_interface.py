"""The simulation for code of your own: `simulate("my.mp4", turbulence="strong", views=9)`."""

import math
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from src.app.compose import compose_config, config_choices
from src.app.own_simulation import OwnSimulation, read_own_clip, set_own_sensor
from src.sim.optics import Position, view_id
from src.sim.scenes import own_material
from src.sim.scenes.video_files import PICTURE_SUFFIXES

VIEW_EVENT = np.dtype(
    [("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8), ("view", np.uint16)]
)
ARGUMENTS = (
    "turbulence", "sensor", "fps", "seconds", "start_s", "end_s", "longest_side_px", "seed",
)  # fmt: skip
NO_OVERRIDES = {key: f"it is the argument {key}" for key in ARGUMENTS}
NO_OVERRIDES |= {"optics.views": "it is the argument views"}
NO_OVERRIDES |= dict.fromkeys(("photo", "video"), "it is the argument photo_or_video")
NO_OVERRIDES |= dict.fromkeys(("write", "like", "split"), "it is of the command line alone")


@dataclass(frozen=True, eq=False)
class SimulatedClip:
    """A clip seen through turbulence; it unpacks into clean, views, tilt and events.

    `clean` (frames, h, w) and `views` (views, frames, h, w): float32 in [0, 1], grey code values.
    `tilt` (views, frames, 2, h, w): float32, displacement (x, y) in pixels.  `events` (n,), in
    order of time: t in us from the first frame on (int64), x, y in pixels of the view (uint16),
    p -1 or 1 (int8), view, an index into `positions` (uint16).  `fps`: frames a second;
    `positions`: (row, col) of each view from the centre view; `drawn`: contrast threshold,
    severity, D/r0 ...
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
    fps: float | None = None, seconds: float | None = None, start_s: float = 0.0, end_s: float = math.inf,
    longest_side_px: int | None = None, seed: int = 0, overrides: Sequence[str] = (),
) -> SimulatedClip:  # fmt: skip
    """Return what a light field of `views` views and an event sensor see of your material.

    `photo_or_video`: a path, of a picture, a video or a folder of frames, or an array, (h, w) or
    (frames, h, w), uint8 or floats in [0, 1].  `turbulence`: none, weak, medium, strong, extreme or
    mixed.  `sensor`: paper, ideal, noisy, evk4 ..., for sRGB and with a contrast threshold of 0.2
    unless `overrides` set sensor.input and sensor.threshold.  `fps`: None for that of the file, 120
    for a photograph, which lasts `seconds` (None: 1); of a video the part from `start_s` to `end_s` is
    taken.  Either is refused where the other is given.
    `overrides`: other keys of conf/simulate.yaml as on the command line.  The result is a function
    of the arguments.  Raises ValueError for values outside their range, and for an override of an
    argument or of a key of the command line alone.
    """
    for override in overrides:
        if (key := override.split("=")[0].lstrip("+~")) in NO_OVERRIDES:
            raise ValueError(f"overrides must not set {key}: {NO_OVERRIDES[key]}")
    if not isinstance(seed, int | np.integer):
        raise ValueError(f"seed must be a whole number, got {seed}")
    for group, choice in (("turbulence", turbulence), ("sensor", sensor)):
        if choice not in (names := config_choices(group)):
            raise ValueError(f"{group} must be one of {', '.join(names)}, got {choice}")
    chosen = [f"turbulence={turbulence}", f"optics.views={views}", f"sensor={sensor}"]
    cfg = compose_config("simulate", *chosen, f"seed={seed}", *overrides)
    set_own_sensor(cfg, overrides)
    options: dict[str, Any] = {"fps": fps, "seconds": seconds, "longest_side_px": longest_side_px}
    options |= {"start_s": start_s, "end_s": end_s}
    if isinstance(photo_or_video, str | Path):
        path = Path(photo_or_video)
        key = "photo" if path.suffix.lower() in PICTURE_SUFFIXES else "video"
        cfg.update(options | {key: str(path)})
        clip = read_own_clip(cfg)
    else:
        options |= {"speed_widths_per_s": cfg.speed_widths_per_s, "seed": cfg.seed}
        clip = own_material.clip_from_array(photo_or_video, white_level=cfg.white_level, **options)
    return simulate_clip(OwnSimulation(cfg, clip))


def simulate_clip(work: OwnSimulation) -> SimulatedClip:
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
    work: OwnSimulation, views: Float[Tensor, "views frames h w"]
) -> np.ndarray:
    """Return the events of all views in order of time."""
    parts = []
    for index, position in enumerate(work.optics.positions):
        light, place = views[index].float(), {"clip": work.key, "view": view_id(position)}
        own = work.sensor.events(light, work.simulated_fps, **place)
        parts.append(np.empty(len(own), VIEW_EVENT))
        parts[-1][[*"txyp"]], parts[-1]["view"] = own[[*"txyp"]], index
    events = np.concatenate(parts)
    return events[np.argsort(events["t"], kind="stable")]
