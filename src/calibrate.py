"""Calibrate: python -m src.calibrate task=views|threshold|turbulence|air recording=...|video=..."""

from pathlib import Path
from typing import Any

import rich
from omegaconf import DictConfig, OmegaConf

from src.app import build, calibrations, entry_point
from src.app.instantiate import build_part
from src.recordings.calibration.scene_alignment import SceneTarget
from src.recordings.files.event_file import ReadOptions
from src.recordings.reconstruction import require_event_network
from src.records import results


def calibrate_views(cfg: DictConfig, run: Path) -> dict:
    """Find the views and their homographies: `views.yaml`, also at `cfg.save`."""
    given: dict[str, Any] = {key: cfg[key] for key in ("resolution", "sensor_size")}
    given["options"] = ReadOptions.from_keys(cfg)
    target = build_part(cfg, "target")
    if isinstance(target, SceneTarget) and not cfg.corners:
        if not cfg.mirrors:
            raise ValueError("mirrors must be true for target=scene, got false")
        found = calibrations.calibrate_views_on_scene(cfg.recording, run, target, **given)
        views, summary = found.aligned.views, found.summary()
    else:
        given |= {key: cfg[key] for key in ("mirrors", "corners")}
        views = calibrations.calibrate_views(cfg.recording, run, target, **given)
        summary = {f"error_px of {v.position}": f"{v.error_px:.3f}" for v in views.views}
    if cfg.save:
        views.save(cfg.save)
    return summary


def find_contrast_threshold(cfg: DictConfig, run: Path) -> dict:
    """Find the contrast threshold by comparing event rates with the configured simulation's."""
    pipeline = build.build_pipeline(cfg, "test")
    clips = [pipeline.render_views([pipeline.draw(index)])[0] for index in range(cfg.clips)]
    estimate = calibrations.calibrate_contrast_threshold(
        cfg.recording, run, clips, cfg.fps * cfg.data.substeps, pipeline.sensor,
        views=cfg.views, sensor_size=cfg.sensor_size, options=ReadOptions.from_keys(cfg),
    )  # fmt: skip
    return {"ON (value, low, high)": estimate.on, "OFF": estimate.off}


def measure_dot_statistics(cfg: DictConfig, run: Path) -> dict:
    """Measure tilt, blur and scintillation of a dot grid against the same without turbulence."""
    given = cfg.ckpt or cfg.get("baseline")
    network = require_event_network(build.load_network(cfg)) if given else None
    statistics = calibrations.measure_dot_grid(
        cfg.recording, cfg.still, run, fps=cfg.fps, network=network, views=cfg.views,
        sensor_size=cfg.sensor_size, options=ReadOptions.from_keys(cfg), **cfg.dots,
    )  # fmt: skip
    return statistics.summary()


def measure_turbulence_in_video(cfg: DictConfig, run: Path) -> dict:
    """Measure the turbulence in front of a still scene: `air.yaml`, also at `cfg.save`."""
    if OmegaConf.is_missing(cfg, "video"):
        raise ValueError("video must be a video of a still scene, got none")
    measured = calibrations.measure_turbulence_in_video(
        cfg.video, run, fps=cfg.fps, save=cfg.save, **cfg.air
    )
    return {name: str(value) for name, value in vars(measured.found).items()}


TASKS = {
    "views": calibrate_views, "threshold": find_contrast_threshold,
    "turbulence": measure_dot_statistics, "air": measure_turbulence_in_video,
}  # fmt: skip


def calibrate(cfg: DictConfig) -> dict:
    """Do `cfg.task`; everything goes below `cfg.paths.run`.  Raises ValueError for another task."""
    if cfg.task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}, got {cfg.task}")
    if cfg.fps is None and cfg.task != "air":
        cfg.fps = 120.0
    run = Path(cfg.paths.run)
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    rich.print(summary := TASKS[cfg.task](cfg, run), f"in {run}")
    return summary


if __name__ == "__main__":
    entry_point.run_command(calibrate, "calibrate")
