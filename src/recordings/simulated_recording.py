"""A simulated recording: nine mirrored, misaligned, vignetted views on one event sensor."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.recordings.files.event_arrays import concatenate_events
from src.recordings.files.event_writers import write_events
from src.recordings.sensor_lookup import SensorLookup, build_lookup
from src.recordings.views import Size, View, Views
from src.sim import noise
from src.sim.optics import view_id
from src.sim.sensor.sensor import EventSensor

BAND_BYTES = 1 << 28  # of sensor frames at a time
FALLOFF = 0.5  # of light, from the middle of a view to that of an edge
DARK = 0.02  # share of light that a sensor pixel gets without any


def kaleidoscope_views(
    positions: list[tuple[int, int]], *, model: Size, sensor: Size = (720, 1280),
    tile_px: float = 230.0, homography_error_px: float = 3.0, key: int = 0,
) -> Views:  # fmt: skip
    """Return the views of a kaleidoscope whose tiles are `tile_px` wide, about the sensor's middle.

    The view at (row, col) is mirrored in x for odd col and in y for odd row.  Each corner of every
    tile but the centre one is displaced by a normal of `homography_error_px` along x and y, a
    function of (key, view).  `model`: (height, width) of the pictures shown.
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
    height, width = lookup.model
    seen = torch.full((frames.shape[1], *view.shape), DARK)
    for index in range(lookup.views):
        y, x = np.nonzero(view == index)
        spot = torch.from_numpy((2 * place[y, x] + 1) / np.array([width, height], np.float32) - 1)
        sampled = functional.grid_sample(
            frames[index, None], spot[None, None], padding_mode="border", align_corners=False
        )
        seen[:, y, x] = DARK + (1 - DARK) * gain[y, x] * sampled[0, :, 0]
    return seen


def record_events(
    frames: Float[Tensor, "views frames h w"], fps: float, views: Views, sensor: EventSensor
) -> np.ndarray:
    """Return the sensor's events (t x y p) in order of time; `frames` are intensities in [0, 1]."""
    lookup = build_lookup(views)
    light = vignette_gain(lookup)
    height, width = views.sensor
    band = max(1, BAND_BYTES // (4 * width * frames.shape[1]))
    parts = []
    for top in range(0, height, band):
        seen = render_sensor_frames(frames, lookup, light, slice(top, min(top + band, height)))
        part = sensor.events(seen, fps, origin=(top, 0), full_width=width)
        part["y"] += top
        parts.append(part)
    events = concatenate_events(parts)
    return events[np.argsort(events["t"], kind="stable")]


def write_recording(
    path: Path | str, frames: Float[Tensor, "views frames h w"], fps: float, views: Views,
    sensor: EventSensor, *, tilt: Float[Tensor, "views frames 2 h w"] | None = None,
) -> int:  # fmt: skip
    """Record `frames`, write them as an event file and return the number of events.

    Beside `cap.raw` come `cap.views.yaml`, the true geometry, and `cap.truth.h5`: the frames of the
    centre view, fps and, where given, the tilt in view pixels.
    """
    path = Path(path)
    events = record_events(frames, fps, views, sensor)
    if not len(events):
        raise ValueError(f"write: the clip gives no events, nothing is written to {path}")
    height, width = views.sensor
    write_events(path, events, width=width, height=height)
    views.save(path.with_suffix(".views.yaml"))
    with h5py.File(path.with_suffix(".truth.h5"), "w") as file:
        file.attrs["fps"], file.attrs["first_event_us"] = fps, events["t"][0]
        file["centre"] = frames[views.positions.index((0, 0))].numpy()
        if tilt is not None:
            file["tilt"] = tilt.numpy()
    return len(events)
