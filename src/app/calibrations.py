"""The calibrations: views, threshold and turbulence of a camera behind a kaleidoscope, and air.

Each reads a recording and writes its file, its table and its picture into a folder.
"""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor, nn

from src.figures import calibration_pictures, event_rate, measured_air
from src.recordings import event_rates, lookup, stream
from src.recordings.calibration import air_meter, alignment, contrast_threshold, dots, statistics
from src.recordings.calibration.boards import Target
from src.recordings.files import formats, sources
from src.recordings.files.measured import SIDE
from src.recordings.views import Views, load
from src.records import results
from src.sim.sensor import EventSensor


def align_views(
    recording: str,
    folder: Path,
    target: Target,
    *,
    resolution: Sequence[int],
    sensor_size: Sequence[int] | None = None,
    mirrors: bool = True,
    margin: float = 0.04,
    threshold_px: float = 1.5,
    corners: str | None = None,
) -> Views:
    """Find the views; write `views.yaml` and `views.png`.

    `corners`: a file of corners given by hand, instead of the target.  Of a calibration that fails,
    with the ValueError of `alignment.align`, `found.png` remains.
    """
    picture = alignment.picture_of(sources.sensor_picture(recording, sensor_size))
    sizes = {"sensor": picture.shape, "model": tuple(resolution)}
    if corners:
        geometry = alignment.by_hand(alignment.read_corners(corners), **sizes)
        calibration_pictures.views_by_hand(picture, geometry, folder / "views.png")
    else:
        seen = alignment.find(picture, target, mirrors)
        calibration_pictures.views_found(picture, seen, folder / "found.png")
        aligned = alignment.align(seen, margin=margin, threshold_px=threshold_px, **sizes)
        calibration_pictures.views_aligned(picture, aligned, folder / "views.png")
        geometry = aligned.views
    geometry.save(folder / "views.yaml")
    return geometry


def find_threshold(
    recording: str,
    folder: Path,
    clips: Sequence[Float[Tensor, "views frames h w"]],
    fps: float,
    sensor: EventSensor,
    *,
    views: str | None = None,
    sensor_size: Sequence[int] | None = None,
) -> contrast_threshold.Estimate:
    """Match the recording's event rate with that of `sensor` looking at `clips`; write
    `threshold.csv` and `threshold.png`."""
    size = sources.sensor_size(recording, sensor_size)
    there = load(views, size) if views else Views.single(size, size)
    events = formats.open_events(recording, size[::-1])
    measured = event_rates.measure(events, lookup.build(there).view)
    estimate = contrast_threshold.estimate(measured, clips, fps, sensor)
    contrast_threshold.write_csv(estimate, measured, folder / "threshold.csv")
    event_rate.threshold(estimate, folder / "threshold.png")
    return estimate


def characterise(
    recording: str,
    still: str,
    folder: Path,
    *,
    fps: float,
    rows: int = 3,
    cols: int = 3,
    dark: bool = True,
    radius: int | None = None,
    views: str | None = None,
    sensor_size: Sequence[int] | None = None,
    network: nn.Module | None = None,
) -> statistics.Statistics:
    """Fit the dots of a recording and of one without turbulence; write `turbulence.csv`, `.png`.

    A recording of events is reconstructed first, each view by itself, by a `network` of one view.
    """
    there = load(views) if views else None
    positions = there.positions if there else [(0, 0)]
    calm, moving = (_films(path, there, fps, sensor_size, network) for path in (still, recording))
    centre = positions.index((0, 0))
    places = statistics.find_dots(calm[centre].mean(0), rows, cols, dark)
    reach = radius or statistics.radius(places)
    if dark:  # the vignette of a bright ground would pass for a part of the dots
        grounds = [statistics.ground(film.mean(0), places, reach) for film in calm]
        light = np.stack(grounds)[:, None]
        calm, moving = calm / light, moving / light
    fits = [[dots.fit(film, places, reach) for film in films] for films in (moving, calm)]
    fitted = statistics.measure(*fits, fps=fps, centre=centre)
    statistics.write_csv(fitted, folder / "turbulence.csv", positions)
    calibration_pictures.turbulence(fitted, positions, folder / "turbulence.png")
    return fitted


def measure_air(
    video: str,
    folder: Path,
    *,
    fps: float | None = None,
    frames: int = 240,
    save: str | None = None,
) -> air_meter.Air:
    """Measure the air in a film of a still scene; write `air.yaml`, also at `save`, and `air.png`.

    At most so many `frames` are read; `fps` None: what the film states.  Raises ValueError for a
    film that cannot be read or shows too little; then nothing is written.
    """
    if not Path(video).exists():
        raise ValueError(f"video must be a film or a folder of pictures, got {video}")
    if fps is not None and not (isinstance(fps, int | float) and 0 < fps < np.inf):
        raise ValueError(f"fps must be > 0 frames a second, got {fps}")
    if frames < air_meter.LEAST_FRAMES:
        raise ValueError(f"air.frames must be at least {air_meter.LEAST_FRAMES}, got {frames}")
    film = [air_meter.shrunk(frame) for frame in islice(sources.film(video, "video"), frames)]
    if len({frame.shape for frame in film}) > 1:
        raise ValueError(f"video must hold frames of one size, got several in {video}")
    rate = sources.frame_rate(video) if fps is None else fps
    air = air_meter.measure(np.stack(film), rate)
    text = f"# The air of {Path(video).name}, {air.frames} frames; pixels of a frame whose smaller"
    text += f" side is {SIDE}.\n{air.found.text()}"
    measured_air.air(air, Path(video).name, folder / "air.png")
    for path in (folder / "air.yaml", *([Path(save)] if save else [])):
        results.write_text(path, text)
    return air


def _films(
    path: str,
    there: Views | None,
    fps: float,
    sensor_size: Sequence[int] | None,
    network: nn.Module | None,
) -> Float[np.ndarray, "views frames h w"]:
    if not sources.holds_events(path):
        frames = [there.register(frame) if there else frame[None] for frame in sources.film(path)]
        return np.stack(frames, axis=1)
    if network is None:
        raise ValueError(f"ckpt or baseline must reconstruct the events of {path}, got neither")
    sensor = sources.sensor_size(path, sensor_size)
    span = stream.overlap("trained", fps)
    table = lookup.build(there or Views.single(sensor, sensor))
    rule = stream.Rule(fps=fps, overlap=span)
    windows = stream.windows(sources.events(path, sensor), table, rule)
    return np.stack(list(stream.each_view(windows, network, overlap=span)), axis=1)
