"""A simulated recording: nine mirrored, misaligned, vignetted views on one event sensor."""

import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.recordings.files.event_arrays import concatenate_events, sort_events
from src.recordings.files.event_writers import write_events
from src.recordings.sensor_lookup import SensorLookup, build_lookup
from src.recordings.views import HeightWidth, View, Views
from src.sim import noise
from src.sim.optics import view_id
from src.sim.sensor.sensor import EventSensor

Part = TypeVar("Part")
Progress = Callable[[Sequence[Part], str], Iterable[Part]]
BAND_BYTES = 1 << 28  # of sensor frames at a time
FALLOFF = 0.5  # of light, from the middle of a view to that of an edge
FILLED = 23 / 24  # of the sensor, by the tiles; the rest is for their displacements
DARK = 0.02  # share of light that a sensor pixel gets without any


def no_progress(parts: Sequence[Part], name: str) -> Iterable[Part]:
    """Return `parts` as they are: the `progress` of work of which none is shown."""
    return parts


def kaleidoscope_views(
    positions: list[tuple[int, int]], *, model: HeightWidth, sensor: HeightWidth = (720, 1280),
    tile_px: float | None = None, homography_error_px: float = 3.0, key: int = 0,
) -> Views:  # fmt: skip
    """Return the views of a kaleidoscope whose tiles are `tile_px` wide (None: as wide as all fit
    on the sensor), about the sensor's middle.

    The view at (row, col) is mirrored in x for odd col and in y for odd row.  Each corner of every
    tile but the centre one is displaced by a normal of `homography_error_px` along x and y, a
    function of (key, view).  `model`: (height, width) of the pictures shown.
    """
    middle = (np.array(sensor[::-1]) - 1) / 2
    if tile_px is None:
        rows, columns = (2 * max(map(abs, axis)) + 1 for axis in zip(*positions, strict=True))
        widest = min(sensor[1] / columns, sensor[0] / rows * model[1] / model[0])
        tile_px = FILLED * widest
    half = np.array([tile_px, tile_px * model[0] / model[1]]) / 2
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    views = []
    for row, col in positions:
        mirror = np.array([-1 if col % 2 else 1, -1 if row % 2 else 1])
        tile = middle + corners * mirror + 2 * half * [col, row]
        if (row, col) != (0, 0):
            own = noise.key(key, view_id((row, col)), "kaleidoscope")
            draw = noise.normal(own, torch.arange(8))
            tile = tile + homography_error_px * draw.reshape(4, 2).numpy()
        onto = (middle + corners).astype(np.float32)
        matrix = cv2.getPerspectiveTransform(tile.astype(np.float32), onto)
        views.append(View((row, col), matrix))
    field = (*(middle - half).tolist(), *(middle + half).tolist())
    return Views(sensor, model, field, tuple(views))


def vignette_gain(lookup: SensorLookup, falloff: float = FALLOFF) -> Float[np.ndarray, "h w"]:
    """Return the share of light each sensor pixel gets: 1 in a view's middle, `falloff` less at
    the middle of an edge (quadratic), 0 outside and at the seam, its last hundredth."""
    half = np.array(lookup.model[::-1]) / 2
    offset = np.abs((lookup.model_xy + 0.5) / half - 1)
    seam = np.clip((1 - offset.max(-1)) / 0.01, 0, 1)
    light = np.clip(1 - falloff * (offset**2).sum(-1), 0, 1) * seam
    return np.where(lookup.view >= 0, light, 0).astype(np.float32)


def render_sensor_frames(
    frames: Float[Tensor, "views frames h w"],
    lookup: SensorLookup,
    light: Float[np.ndarray, "sensor_h sensor_w"],
    rows: slice,
) -> Float[Tensor, "frames rows sensor_w"]:
    """Return what the sensor's `rows` see: each view's frames at each pixel's place, bilinear."""
    view, place, gain = lookup.view[rows], lookup.model_xy[rows], torch.from_numpy(light[rows])
    seen = torch.full((frames.shape[1], *view.shape), DARK)
    for index in range(lookup.views):
        y, x = np.nonzero(view == index)
        if len(y):
            sampled = _sample(frames[index], place[y, x])
            seen[:, y, x] = DARK + (1 - DARK) * gain[y, x] * sampled
    return seen


def _sample(
    frames: Float[Tensor, "frames h w"], places: Float[np.ndarray, "n 2"]
) -> Float[Tensor, "frames n"]:
    """Return all frames at `places` (x, y), bilinear, float32; at the border its pixel's value.

    Only the rows that are wanted are read, and the result at a place does not depend on the others.
    """
    last = np.array(frames.shape[:0:-1]) - 1
    places = np.clip(places, 0, last)
    low = np.floor(places).astype(np.int64)
    high = np.minimum(low + 1, last)
    (x0, y0), (x1, y1) = low.T, high.T
    top, width = y0.min(), frames.shape[-1]
    rows = frames[:, top : y1.max() + 1].float().flatten(1)
    corners = [torch.from_numpy((y - top) * width + x) for y in (y0, y1) for x in (x0, x1)]
    x_share, y_share = torch.from_numpy((places - low).astype(np.float32)).T
    upper, lower = (
        torch.lerp(rows.index_select(1, left), rows.index_select(1, right), x_share)
        for left, right in (corners[:2], corners[2:])
    )
    return torch.lerp(upper, lower, y_share)


def record_events(
    frames: Float[Tensor, "views frames h w"], fps: float, views: Views, sensor: EventSensor,
    progress: Progress[int] = no_progress, *, key: int = 0,
) -> np.ndarray:  # fmt: skip
    """Return the sensor's events (t x y p) in order of time; `frames` are intensities in [0, 1], of
    16 or 32 bits, also on a disk (np.memmap).  The noise follows from `key`.

    The sensor is simulated in bands of rows, in one where its timestamps are v2e's: these depend on
    the pixel with most events.  `progress(parts, name)` yields the parts of the work, as
    rich.progress.track does.
    """
    lookup = build_lookup(views)
    light = vignette_gain(lookup)
    height, width = views.sensor
    band = max(1, BAND_BYTES // (4 * width * frames.shape[1]))
    if getattr(sensor, "stamps", None) == "v2e":  # a sensor of your own may have none
        band = height
    parts = []
    for top in progress(range(0, height, band), "events"):
        seen = render_sensor_frames(frames, lookup, light, slice(top, min(top + band, height)))
        part = sensor.events(seen, fps, clip=key, origin=(top, 0), full_width=width)
        part["y"] += top
        parts.append(part)
    return sort_events(concatenate_events(parts))


def write_recording(
    path: Path | str, frames: Float[Tensor, "views frames h w"], fps: float, views: Views,
    sensor: EventSensor, progress: Progress[int] = no_progress, *, key: int = 0,
) -> np.ndarray:  # fmt: skip
    """Record `frames` as `record_events`, write the events as an event file and return them.

    Beside `cap.raw` comes `cap.views.yaml`, the true geometry.  A clip without events gives a file
    without events, and a warning.
    """
    path = Path(path)
    events = record_events(frames, fps, views, sensor, progress, key=key)
    if not len(events):
        more = "sensor.threshold= (lower), seconds= (longer) or turbulence= (stronger)"
        warnings.warn(
            f"the clip gives no events, {path} holds none; {more} gives some", stacklevel=2
        )
    height, width = views.sensor
    write_events(path, events, width=width, height=height)
    views.save(path.with_suffix(".views.yaml"))
    return events
