"""The three calibrations of a camera behind a kaleidoscope: views, threshold, turbulence.

Each reads a recording and writes its file, its table and its picture into a folder.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor, nn

from src.figures import event_rate, views_found
from src.recordings import event_rates, lookup, stream
from src.recordings.calibration import alignment, contrast, dots, statistics
from src.recordings.calibration.boards import Target
from src.recordings.files import formats, sources
from src.recordings.views import Views, load


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
        found = alignment.by_hand(alignment.read_corners(corners), **sizes)
        views_found.views_by_hand(picture, found, folder / "views.png")
    else:
        seen = alignment.find(picture, target, mirrors)
        views_found.views_found(picture, seen, folder / "found.png")
        aligned = alignment.align(seen, margin=margin, threshold_px=threshold_px, **sizes)
        views_found.views_aligned(picture, aligned, folder / "views.png")
        found = aligned.views
    found.save(folder / "views.yaml")
    return found


def find_threshold(
    recording: str,
    folder: Path,
    clips: Sequence[Float[Tensor, "views frames h w"]],
    fps: float,
    sensor: dict,
    *,
    views: str | None = None,
    sensor_size: Sequence[int] | None = None,
) -> contrast.Estimate:
    """Match the recording's event rate with that of `sensor` looking at `clips`; write
    `threshold.csv` and `threshold.png`."""
    size = sources.sensor_size(recording, sensor_size)
    there = load(views, size) if views else Views.single(size, size)
    events = formats.open_events(recording, size[::-1])
    measured = event_rates.measure(events, lookup.build(there).view)
    found = contrast.estimate(measured, clips, fps, sensor)
    contrast.write_csv(found, measured, folder / "threshold.csv")
    event_rate.threshold(found, folder / "threshold.png")
    return found


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
    found = statistics.measure(*fits, fps=fps, centre=centre)
    statistics.write_csv(found, folder / "turbulence.csv", positions)
    views_found.turbulence(found, positions, folder / "turbulence.png")
    return found


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
    windows = stream.windows(
        sources.events(path, sensor), table, stream.Rule(fps=fps, overlap=span)
    )
    return np.stack(list(stream.each_view(windows, network, overlap=span)), axis=1)
