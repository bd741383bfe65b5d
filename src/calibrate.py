"""Calibrate: python -m src.calibrate task=views|threshold|turbulence|air recording=...|video=...

Each task writes its file, its table and its picture into the folder of the run.
"""

import copy
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from rich.progress import track

from src.app import entry_point, methods, simulation
from src.app.instantiate import build_part
from src.deploy.picture_size import check_picture_size
from src.figures import calibration_figures
from src.models.network import EventToVideoNetwork
from src.recordings import event_windows, reconstruction, sensor_lookup
from src.recordings.calibration import (
    activity_pictures,
    contrast_threshold,
    scene_alignment,
    view_alignment,
)
from src.recordings.calibration.boards import Target, check_grid_size
from src.recordings.files import recording_inputs, videos
from src.recordings.files.event_file import ReadOptions
from src.recordings.files.recording import open_recording
from src.recordings.files.turbulence_file import SIDE
from src.recordings.turbulence_measurement import dot_statistics, gaussian_dots, turbulence_meter
from src.recordings.turbulence_measurement.gaussian_dots import GaussianFits
from src.recordings.views import Views, load_views
from src.records import results
from src.records.atomic import check_writable, write_text
from src.sim.pipeline import Pipeline

MOST_NOISE = 0.2  # of a recording's events, by noise, without a warning
MOST_LEFT_OUT = 0.05  # of a view, by another aspect, that is not worth a word
Films = Float[np.ndarray, "views frames h w"]


def calibrate_views(cfg: DictConfig, run: Path) -> dict[str, str]:
    """Find the views and their homographies; write `views.yaml`, also at `cfg.save`, and
    `views.png`.  Return a line per view."""
    check_picture_size(*cfg.resolution)
    target = build_part(cfg, "target")
    if isinstance(target, scene_alignment.SceneTarget) and not cfg.corners:
        views, summary = _find_views_in_scene(cfg, run, target)
    else:
        views = _find_views_of_board(cfg, run, target)
        summary = {f"error_px of {v.position}": f"{v.error_px:.3f}" for v in views.views}
    for path in filter(None, (run / "views.yaml", cfg.save)):
        views.save(path)
    return summary | {"resolution": describe_resolution(views)}


def describe_resolution(views: Views) -> str:
    """Return the size of a view's picture and, where its aspect leaves out more than MOST_LEFT_OUT
    of each view, on which sides and the `resolution` that keeps them."""
    (height, width), (left, top, right, bottom) = views.model, views.field
    middle, size = np.array([[(left + right) / 2, (top + bottom) / 2]]), f"{width}x{height} px"
    apart = {view.position: np.abs(view.to_sensor(middle) - middle)[0] for view in views.views}
    across = [apart[at][0] for at in ((0, -1), (0, 1)) if at in apart]
    down = [apart[at][1] for at in ((-1, 0), (1, 0)) if at in apart]
    if not across or not down:
        return size
    ratio = float(np.mean(across) / np.mean(down)) * height / width  # of the views to the picture
    where, kept = "left and right", [height, round(width * ratio)]
    if ratio < 1:
        where, kept = "top and bottom", [round(height / ratio), width]
    lost, keep = 1 - min(ratio, 1 / ratio), f"resolution=[{kept[0]},{kept[1]}] keeps it"
    if lost < MOST_LEFT_OUT:
        return size
    return f"{size}; {lost:.0%} of each view is left out, {where}: {keep}"


def _find_views_of_board(cfg: DictConfig, run: Path, target: Target) -> Views:
    """Find the views by a board, or by `cfg.corners`, a file of corners given by hand.

    Of a calibration that fails, with the ValueError of `view_alignment.fit_homographies`,
    `found.png` remains.
    """
    options = ReadOptions.from_keys(cfg)
    seen = recording_inputs.read_picture_or_event_counts(cfg.recording, cfg.sensor_size, options)
    picture = view_alignment.repair_picture(seen)
    sizes = {"sensor": picture.shape, "model": tuple(cfg.resolution)}
    if cfg.corners:
        corners = view_alignment.read_corners(cfg.corners, cfg.mirrors)
        views = view_alignment.views_from_corners(corners, **sizes)
        calibration_figures.draw_views(picture, views, run / "views.png")
        return views
    found = view_alignment.find_target_in_views(picture, target, cfg.mirrors)
    calibration_figures.draw_found_target(picture, found, run / "found.png")
    aligned = view_alignment.fit_homographies(found, **sizes)
    calibration_figures.draw_view_residuals(picture, aligned, run / "views.png")
    return aligned.views


def _find_views_in_scene(
    cfg: DictConfig, run: Path, scene: scene_alignment.SceneTarget
) -> tuple[Views, dict[str, str]]:
    """Find the views of a kaleidoscope in whatever it shows; also write `overlay.png`.

    Raises ValueError as `scene_alignment.align_views_by_scene` does.
    """
    if not cfg.mirrors:
        how = "the views of a lens array are found by a board, target=checkerboard"
        raise ValueError(f"mirrors must be true for target=scene, got false: {how}")
    pictures = activity_pictures.read_activity_pictures(
        cfg.recording, cfg.sensor_size, ReadOptions.from_keys(cfg)
    )
    found = scene_alignment.align_views_by_scene(pictures, scene, tuple(cfg.resolution))
    views, total = found.aligned.views, pictures.sum((0, 1))
    shown = view_alignment.repair_picture(np.log1p(total))
    calibration_figures.draw_view_residuals(shown, found.aligned, run / "views.png")
    calibration_figures.draw_views_over_centre(total, views, found.matched, run / "overlay.png")
    return views, found.summary()


def find_contrast_threshold(cfg: DictConfig, run: Path) -> dict[str, tuple | float]:
    """Match the recording's event rate with that of the configured simulation; write
    `threshold.csv` and `threshold.png`."""
    if cfg.clips < 1:
        raise ValueError(f"clips must be >= 1, got {cfg.clips}")
    if type(cfg.warmup_windows) is not int or cfg.warmup_windows < 0:
        wanted = "a whole number >= 0"
        raise ValueError(f"warmup_windows must be {wanted}, got {cfg.warmup_windows}")
    options, pipeline = ReadOptions.from_keys(cfg), _build_warmed_up_pipeline(cfg)
    views = recording_inputs.find_views(cfg.recording, cfg.views, cfg.sensor_size, options)
    lookup = sensor_lookup.build_lookup(views)
    events = open_recording(cfg.recording, views.sensor, options)
    measured = contrast_threshold.measure_event_rates(events, lookup.view)
    contrast_threshold.require_both_polarities(measured)
    drawn = [pipeline.draw(index) for index in range(cfg.clips)]
    clips = [pipeline.render_views([one])[0].half() for one in track(drawn, "simulated clips")]
    estimate = contrast_threshold.estimate_contrast_threshold(
        measured, clips, cfg.fps * cfg.data.substeps, pipeline.sensor, progress=track,
        warmup=cfg.warmup_windows * cfg.data.substeps,
    )  # fmt: skip
    if cfg.clips == 1:
        warnings.warn("clips=1: the interval holds no difference of scenes", stacklevel=2)
    if estimate.noise_share > MOST_NOISE:
        warnings.warn(
            f"{estimate.noise_share:.0%} of the recording's events are what the simulated sensor"
            " makes without change of light: C follows from sensor.dark_noise_hz and"
            " sensor.leak_event_hz, which must be the camera's", stacklevel=2,
        )  # fmt: skip
    contrast_threshold.write_threshold_csv(estimate, measured, run / "threshold.csv")
    calibration_figures.draw_event_rates(estimate, run / "threshold.png")
    return {
        "ON (value, low, high)": estimate.on,
        "OFF": estimate.off,
        "noise, share of the events": estimate.noise_share,
    }


def _build_warmed_up_pipeline(cfg: DictConfig) -> Pipeline:
    """Return the simulation of test clips with `cfg.warmup_windows` more windows."""
    longer = copy.deepcopy(cfg)
    longer.data.test_windows += cfg.warmup_windows
    return simulation.build_pipeline(longer, "test")


def measure_dot_statistics(cfg: DictConfig, run: Path) -> dot_statistics.DotStatistics:
    """Measure tilt, blur and scintillation of a dot grid against the same without turbulence;
    write `turbulence.csv`, `.png`.

    A recording of events is reconstructed first, each view by itself, by a network of one view.
    """
    _check_dot_options(cfg)
    views = None if cfg.views is None else load_views(cfg.views)
    positions = views.positions if views else [(0, 0)]
    centre = positions.index((0, 0))
    turbulent_fits, still_fits = _fit_dots(cfg.dots, *_load_dot_films(cfg, views), centre)
    fitted = dot_statistics.compare_with_still(
        turbulent_fits, still_fits, fps=cfg.fps, centre_view=centre
    )
    dot_statistics.write_view_dot_csv(fitted, run / "turbulence.csv", positions)
    calibration_figures.draw_dot_statistics(fitted, positions, run / "turbulence.png")
    return fitted


def _check_dot_options(cfg: DictConfig) -> None:
    if not cfg.still:
        raise ValueError("still must be the same dots without turbulence, got none")
    for key in ("still", "recording"):
        if not Path(cfg[key]).exists():
            wanted = f"{key} must be a film, a folder of pictures or events"
            raise ValueError(f"{wanted}, got {cfg[key]}, which does not exist")
    check_grid_size(cfg.dots.rows, cfg.dots.cols, "dots")


def _load_dot_films(cfg: DictConfig, views: Views | None) -> tuple[Films, Films]:
    """Return the films of `recording` and of `still`; ValueError for pictures of two sizes."""
    given = cfg.ckpt or cfg.get("baseline")
    network = (
        reconstruction.require_event_network(methods.load_ckpt_or_baseline(cfg)) if given else None
    )
    still, turbulent = (_read_films(cfg, key, views, network) for key in ("still", "recording"))
    wanted, got = ("x".join(map(str, films.shape[2:])) for films in (turbulent, still))
    if wanted != got:
        raise ValueError(f"still must have pictures of the recording's size, {wanted}, got {got}")
    return turbulent, still


def _fit_dots(
    dots: DictConfig, turbulent: Films, still: Films, centre: int
) -> tuple[list[GaussianFits], list[GaussianFits]]:
    """Return the fits of the dots in the films of each view, with turbulence and without."""
    places = dot_statistics.find_dots(still[centre].mean(0), dots.rows, dots.cols, dots.dark)
    reach = dots.fit_radius_px or dot_statistics.choose_fit_radius(places)
    if dots.dark:
        turbulent, still = _divide_by_background(turbulent, still, places, reach)
    turbulent_fits, still_fits = (
        [gaussian_dots.fit_gaussians(film, places, reach) for film in films]
        for films in (turbulent, still)
    )
    return turbulent_fits, still_fits


def _divide_by_background(
    turbulent: Films, still: Films, places: Float[np.ndarray, "dots 2"], reach: int
) -> tuple[Films, Films]:
    """Return the films over the bright ground of each view: its vignette would pass for a part of
    the dots."""
    grounds = [dot_statistics.fit_background(film.mean(0), places, reach) for film in still]
    light = np.stack(grounds)[:, None]
    return turbulent / light, still / light


def _read_films(
    cfg: DictConfig, key: str, views: Views | None, network: EventToVideoNetwork | None
) -> Films:
    path = cfg[key]
    if not recording_inputs.has_events(path):
        frames = videos.read_video(path, key)
        return np.stack([views.warp_to_model(f) if views else f[None] for f in frames], axis=1)
    if network is None:
        raise ValueError(f"ckpt or baseline must reconstruct the events of {path}, got neither")
    options = ReadOptions.from_keys(cfg)
    seen = recording_inputs.find_views(path, cfg.views, cfg.sensor_size, options)
    rule = event_windows.build_window_rule("trained", fps=cfg.fps)
    events = recording_inputs.iter_recording(path, seen.sensor, options=options)
    windows = event_windows.cut_windows(events, sensor_lookup.build_lookup(seen), rule)
    pictures = reconstruction.reconstruct_each_view(windows, network, rule.overlapping_windows)
    return np.stack(list(pictures), axis=1)


def measure_turbulence_in_video(
    cfg: DictConfig, run: Path
) -> turbulence_meter.TurbulenceMeasurement:
    """Measure the turbulence in front of a still scene; write `air.yaml`, also at `cfg.save`, and
    `air.png`.

    Raises ValueError for a video that cannot be read or shows too little; then nothing is written.
    """
    if OmegaConf.is_missing(cfg, "video"):
        raise ValueError("video must be a video of a still scene, got none")
    video, most, fps = cfg.video, cfg.air.max_frames, cfg.fps
    if not Path(video).exists():
        raise ValueError(f"video must be a film or a folder of pictures, got {video}")
    if most < (least := turbulence_meter.MIN_FRAMES):
        raise ValueError(f"air.max_frames must be at least {least}, got {most}")
    frames = videos.read_video(video, "video", most)
    film = list(map(turbulence_meter.limit_shorter_side, frames))
    if len({frame.shape for frame in film}) > 1:
        raise ValueError(f"video must hold frames of one size, got several in {video}")
    rate = videos.read_fps(video, "video", most) if fps is None else fps
    air = turbulence_meter.measure_turbulence(np.stack(film), rate)
    text = f"# The air of {Path(video).name}, {air.frames} frames; pixels of a frame whose smaller"
    text += f" side is {SIDE}.\n"
    if air.camera_drift_px:
        text += f"# A camera drift of {air.camera_drift_px:.2g} px over the film was removed.\n"
    text += air.found.to_yaml()
    calibration_figures.draw_measured_turbulence(air, Path(video).name, run / "air.png")
    for path in filter(None, (run / "air.yaml", cfg.save)):
        write_text(Path(path), text)
    return air


TASKS: dict[str, Callable[[DictConfig, Path], dict]] = {
    "views": calibrate_views,
    "threshold": find_contrast_threshold,
    "turbulence": lambda *given: measure_dot_statistics(*given).summary(),
    "air": lambda *given: measure_turbulence_in_video(*given).summary(),
}
SAVED_TASKS = ("views", "air")  # which write a file that `save` has, too


def format_value(value: object) -> str:
    """Return a number with three significant digits, several joined, a text as it is."""
    if isinstance(value, tuple):
        return ", ".join(map(format_value, value))
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def calibrate(cfg: DictConfig) -> dict:
    """Do `cfg.task`; everything goes below `cfg.paths.run`.

    Raises ValueError for another task, an `fps` that is no rate and a `save` that is no file or of
    a task that has none.
    """
    if cfg.task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}, got {cfg.task}")
    if cfg.fps is not None and not 0.02 <= cfg.fps <= 1e5:  # decays of air.yaml are 1e-5 to 60 s
        raise ValueError(f"fps must be in [0.02, 1e5] frames a second, got {cfg.fps}")
    if cfg.save and cfg.task not in SAVED_TASKS:
        raise ValueError(f"save must be null for task={cfg.task}, got {cfg.save}")
    if cfg.save and Path(cfg.save).is_dir():
        raise ValueError(f"save must be a file to write, got {cfg.save}: a folder")
    if cfg.save:
        check_writable(Path(cfg.save), "save")
    if cfg.fps is None and cfg.task != "air":
        is_film = cfg.task == "turbulence" and not recording_inputs.has_events(cfg.recording)
        stated = videos.read_fps(cfg.recording, "recording") if is_film else None
        cfg.fps = stated or 120.0
    run = Path(cfg.paths.run)
    with results.store_config_when_done(run, entry_point.resolved_yaml(cfg)):
        summary = TASKS[cfg.task](cfg, run)
    for name, value in summary.items():
        print(f"{name}: {format_value(value)}")
    if cfg.save:
        print(f"saved in {cfg.save}")
    print(f"in {run}")
    return summary


if __name__ == "__main__":
    entry_point.run_command(calibrate, "calibrate")
