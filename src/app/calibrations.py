"""The calibrations: views, threshold and turbulence of a camera behind a kaleidoscope, and air.

Each reads a recording and writes its file, its table and its picture into a folder.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from src.figures import calibration_figures
from src.models.network import EventToVideoNetwork
from src.recordings import event_windows, reconstruction, sensor_lookup
from src.recordings.calibration import (
    activity_pictures,
    contrast_threshold,
    dot_statistics,
    gaussian_dots,
    scene_alignment,
    turbulence_meter,
    view_alignment,
)
from src.recordings.calibration.boards import Target
from src.recordings.files import sources, videos
from src.recordings.files.event_file import ReadOptions
from src.recordings.files.recording import open_recording
from src.recordings.files.turbulence_file import SIDE
from src.recordings.views import Views, load_views, views_or_whole_sensor
from src.records import results
from src.sim.sensor.sensor import Sensor


def calibrate_views(
    recording: str,
    folder: Path,
    target: Target,
    *,
    resolution: Sequence[int],
    sensor_size: Sequence[int] | None = None,
    mirrors: bool = True,
    corners: str | None = None,
    options: ReadOptions = ReadOptions(),
) -> Views:
    """Find the views; write `views.yaml` and `views.png`.

    `corners`: a file of corners given by hand, instead of the target.  Of a calibration that fails,
    with the ValueError of `view_alignment.fit_homographies`, `found.png` remains.
    """
    picture = view_alignment.repair_picture(
        sources.read_sensor_picture(recording, sensor_size, options)
    )
    sizes = {"sensor": picture.shape, "model": tuple(resolution)}
    if corners:
        geometry = view_alignment.views_from_corners(view_alignment.read_corners(corners), **sizes)
        calibration_figures.draw_views(picture, geometry, folder / "views.png")
    else:
        seen = view_alignment.find_target(picture, target, mirrors)
        calibration_figures.draw_found_target(picture, seen, folder / "found.png")
        aligned = view_alignment.fit_homographies(seen, **sizes)
        calibration_figures.draw_view_residuals(picture, aligned, folder / "views.png")
        geometry = aligned.views
    geometry.save(folder / "views.yaml")
    return geometry


def calibrate_views_on_scene(
    recording: str,
    folder: Path,
    scene: scene_alignment.SceneTarget,
    *,
    resolution: Sequence[int],
    sensor_size: Sequence[int] | None = None,
    options: ReadOptions = ReadOptions(),
) -> scene_alignment.SceneAlignment:
    """Find the views of a kaleidoscope in whatever it shows; write `views.yaml`, `views.png` and
    `overlay.png`.  Raises ValueError as `scene_alignment.align_scene` does."""
    pictures = activity_pictures.read_activity_pictures(recording, sensor_size, options)
    found = scene_alignment.align_scene(pictures, scene, (resolution[0], resolution[1]))
    total = pictures.sum((0, 1))
    shown = view_alignment.repair_picture(np.log1p(total))
    calibration_figures.draw_view_residuals(shown, found.aligned, folder / "views.png")
    views, overlay = found.aligned.views, folder / "overlay.png"
    calibration_figures.draw_view_overlays(total, views, found.matched, overlay)
    views.save(folder / "views.yaml")
    return found


def calibrate_contrast_threshold(
    recording: str,
    folder: Path,
    clips: Sequence[Float[Tensor, "views frames h w"]],
    fps: float,
    sensor: Sensor,
    *,
    views: str | None = None,
    sensor_size: Sequence[int] | None = None,
    options: ReadOptions = ReadOptions(),
) -> contrast_threshold.ThresholdEstimate:
    """Match the recording's event rate with that of `sensor` looking at `clips`; write
    `threshold.csv` and `threshold.png`."""
    size = sources.find_sensor_size(recording, sensor_size, options)
    there = views_or_whole_sensor(views, size)
    events = open_recording(recording, size[::-1], options)
    measured = contrast_threshold.measure_event_rates(
        events, sensor_lookup.build_lookup(there).view
    )
    estimate = contrast_threshold.estimate_contrast_threshold(measured, clips, fps, sensor)
    contrast_threshold.write_threshold_csv(estimate, measured, folder / "threshold.csv")
    calibration_figures.draw_event_rates(estimate, folder / "threshold.png")
    return estimate


def measure_dot_grid(
    recording: str,
    still: str,
    folder: Path,
    *,
    fps: float,
    rows: int = 3,
    cols: int = 3,
    dark: bool = True,
    fit_radius_px: int | None = None,
    views: str | None = None,
    sensor_size: Sequence[int] | None = None,
    network: EventToVideoNetwork | None = None,
    options: ReadOptions = ReadOptions(),
) -> dot_statistics.DotStatistics:
    """Fit the dots of a recording and of one without turbulence; write `turbulence.csv`, `.png`.

    A recording of events is reconstructed first, each view by itself, by a `network` of one view.
    """
    there = load_views(views) if views else None
    positions = there.positions if there else [(0, 0)]
    given = there, fps, sensor_size, network, options
    calm, moving = (_films(path, *given) for path in (still, recording))
    centre = positions.index((0, 0))
    places = dot_statistics.find_dots(calm[centre].mean(0), rows, cols, dark)
    reach = fit_radius_px or dot_statistics.choose_fit_radius(places)
    if dark:  # the vignette of a bright ground would pass for a part of the dots
        grounds = [dot_statistics.fit_background(film.mean(0), places, reach) for film in calm]
        light = np.stack(grounds)[:, None]
        calm, moving = calm / light, moving / light
    turbulent = [gaussian_dots.fit_gaussians(film, places, reach) for film in moving]
    still_fits = [gaussian_dots.fit_gaussians(film, places, reach) for film in calm]
    fitted = dot_statistics.compare_with_still(turbulent, still_fits, fps=fps, centre=centre)
    dot_statistics.write_view_dot_csv(fitted, folder / "turbulence.csv", positions)
    calibration_figures.draw_dot_statistics(fitted, positions, folder / "turbulence.png")
    return fitted


def measure_turbulence_in_video(
    video: str,
    folder: Path,
    *,
    fps: float | None = None,
    max_frames: int = 240,
    save: str | None = None,
) -> turbulence_meter.TurbulenceMeasurement:
    """Measure the turbulence of a video of a still scene; write `air.yaml`, also at `save`, and
    `air.png`.

    At most `max_frames` are read; `fps` None: that of the video.  Raises ValueError for a
    video that cannot be read or shows too little; then nothing is written.
    """
    if not Path(video).exists():
        raise ValueError(f"video must be a film or a folder of pictures, got {video}")
    if fps is not None and not (isinstance(fps, int | float) and 0 < fps < np.inf):
        raise ValueError(f"fps must be > 0 frames a second, got {fps}")
    if max_frames < turbulence_meter.MIN_FRAMES:
        raise ValueError(
            f"air.max_frames must be at least {turbulence_meter.MIN_FRAMES}, got {max_frames}"
        )
    frames = videos.read_video(video, "video", max_frames)
    film = list(map(turbulence_meter.shrink_frame, frames))
    if len({frame.shape for frame in film}) > 1:
        raise ValueError(f"video must hold frames of one size, got several in {video}")
    rate = videos.read_fps(video, "video", max_frames) if fps is None else fps
    air = turbulence_meter.measure_turbulence(np.stack(film), rate)
    text = f"# The air of {Path(video).name}, {air.frames} frames; pixels of a frame whose smaller"
    text += f" side is {SIDE}.\n{air.found.to_yaml()}"
    calibration_figures.draw_measured_turbulence(air, Path(video).name, folder / "air.png")
    for path in (folder / "air.yaml", *([Path(save)] if save else [])):
        results.write_text(path, text)
    return air


def _films(
    path: str,
    there: Views | None,
    fps: float,
    sensor_size: Sequence[int] | None,
    network: EventToVideoNetwork | None,
    options: ReadOptions,
) -> Float[np.ndarray, "views frames h w"]:
    if not sources.has_events(path):
        frames = videos.read_video(path)
        return np.stack([there.warp_to_model(f) if there else f[None] for f in frames], axis=1)
    if network is None:
        raise ValueError(f"ckpt or baseline must reconstruct the events of {path}, got neither")
    sensor = sources.find_sensor_size(path, sensor_size, options)
    span = event_windows.frames_per_window("trained", fps)
    table = sensor_lookup.build_lookup(there or Views.single_view(sensor, sensor))
    rule = event_windows.WindowRule(fps=fps, frames_per_window=span)
    events = sources.iter_recording(path, sensor, options=options)
    windows = event_windows.cut_windows(events, table, rule)
    return np.stack(list(reconstruction.reconstruct_each_view(windows, network, span)), axis=1)
