"""A simulated recording: nine mirrored, misaligned, vignetted views on one event sensor.

The true geometry is a `Views`, so that a calibration can be compared with it; a sensor pixel sees
what `Lookup` says it does, the same table that splits the events again.
"""

from pathlib import Path

import cv2
import h5py
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.recordings.files.event_arrays import joined
from src.recordings.files.formats import write_events
from src.recordings.lookup import Lookup, build
from src.recordings.views import Size, View, Views
from src.sim import noise
from src.sim.optics import view_id
from src.sim.sensor.sensor import EventSensor

BAND_BYTES = 1 << 28  # of sensor frames at a time


def kaleidoscope(
    positions: list[tuple[int, int]],
    *,
    model: Size,
    sensor: Size = (720, 1280),
    tile_px: float = 230.0,
    misalignment_px: float = 3.0,
    key: int = 0,
) -> Views:
    """Return the views of a kaleidoscope whose tiles are `tile_px` wide, about the sensor's middle.

    The view at (row, col) is mirrored in x for odd col and in y for odd row.  Each corner of every
    tile but the centre one is displaced by a normal of `misalignment_px` along x and y, a function
    of (key, view).  `model` (height, width) is the size of the pictures shown, of any aspect.
    """
    middle = (np.array(sensor[::-1]) - 1) / 2
    half = np.array([tile_px, tile_px * model[0] / model[1]]) / 2
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    views = []
    for row, col in positions:
        mirror = np.array([-1 if col % 2 else 1, -1 if row % 2 else 1])
        tile = middle + corners * mirror + 2 * half * [col, row]
        if (row, col) != (0, 0):
            own = noise.key(key, view_id((row, col)), "kaleidoscope")
            draw = noise.normal(own, torch.arange(8))
            tile = tile + misalignment_px * draw.reshape(4, 2).numpy()
        onto = (middle + corners).astype(np.float32)
        matrix = cv2.getPerspectiveTransform(tile.astype(np.float32), onto)
        views.append(View((row, col), matrix))
    field = (*(middle - half).tolist(), *(middle + half).tolist())
    return Views(sensor, model, field, tuple(views))


def vignette(lookup: Lookup, falloff: float = 0.5) -> Float[np.ndarray, "h w"]:
    """Return the share of light each sensor pixel gets: 1 in the middle of a view, 0 outside.

    It falls by `falloff` at the middle of an edge, quadratically, and to nothing within the last
    hundredth of the view, its seam.
    """
    half = np.array(lookup.model[::-1]) / 2
    offset = np.abs((lookup.place + 0.5) / half - 1)
    seam = np.clip((1 - offset.max(-1)) / 0.01, 0, 1)
    light = np.clip(1 - falloff * (offset**2).sum(-1), 0, 1) * seam
    return np.where(lookup.view >= 0, light, 0).astype(np.float32)


def sensor_frames(
    frames: Float[Tensor, "views frames h w"],
    lookup: Lookup,
    light: Float[np.ndarray, "sensor_h sensor_w"],
    rows: slice,
    dark: float = 0.02,
) -> Float[Tensor, "frames rows sensor_w"]:
    """Return what the sensor's `rows` see: each view's frames at each pixel's place, bilinear."""
    view, place, gain = lookup.view[rows], lookup.place[rows], torch.from_numpy(light[rows])
    height, width = lookup.model
    seen = torch.full((frames.shape[1], *view.shape), dark)
    for index in range(lookup.views):
        y, x = np.nonzero(view == index)
        spot = torch.from_numpy((2 * place[y, x] + 1) / np.array([width, height], np.float32) - 1)
        sampled = functional.grid_sample(
            frames[index, None], spot[None, None], padding_mode="border", align_corners=False
        )
        seen[:, y, x] = dark + (1 - dark) * gain[y, x] * sampled[0, :, 0]
    return seen


def record(
    frames: Float[Tensor, "views frames h w"],
    fps: float,
    views: Views,
    sensor: EventSensor,
    *,
    falloff: float = 0.5,
    dark: float = 0.02,
) -> np.ndarray:
    """Return the sensor's events (t x y p) in order of time; `frames` are intensities in [0, 1]."""
    lookup = build(views)
    light = vignette(lookup, falloff)
    height, width = views.sensor
    band = max(1, BAND_BYTES // (4 * width * frames.shape[1]))
    parts = []
    for top in range(0, height, band):
        seen = sensor_frames(frames, lookup, light, slice(top, min(top + band, height)), dark)
        part = sensor.events(seen, fps, origin=(top, 0), full_width=width)
        part["y"] += top
        parts.append(part)
    events = joined(parts)
    return events[np.argsort(events["t"], kind="stable")]


def write_recording(
    path: Path | str,
    frames: Float[Tensor, "views frames h w"],
    fps: float,
    views: Views,
    sensor: EventSensor,
    *,
    tilt: Float[Tensor, "views frames 2 h w"] | None = None,
    **scene,
) -> int:
    """Record `frames`, write them as an event file and return the number of events.

    Beside `cap.raw` come `cap.views.yaml`, the true geometry, and `cap.truth.h5`: the frames of the
    centre view, fps and, where given, the tilt in view pixels.  `scene` goes to `record`.
    """
    path = Path(path)
    events = record(frames, fps, views, sensor, **scene)
    height, width = views.sensor
    write_events(path, events, width=width, height=height)
    views.save(path.with_suffix(".views.yaml"))
    with h5py.File(path.with_suffix(".truth.h5"), "w") as file:
        file.attrs["fps"], file.attrs["first_event_us"] = fps, events["t"][0]
        file["centre"] = frames[views.positions.index((0, 0))].numpy()
        if tilt is not None:
            file["tilt"] = tilt.numpy()
    return len(events)
