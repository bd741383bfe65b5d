"""Calibrate: python -m src.calibrate task=views|threshold|turbulence recording=...

Or task=air video=...
"""

from pathlib import Path

import hydra
import rich
from omegaconf import DictConfig, OmegaConf

from src.app import build, calibrations, door
from src.records import results


def views(cfg: DictConfig, run: Path) -> dict:
    """Find the views and their homographies: `views.yaml`, also at `cfg.save`."""
    names = ("resolution", "sensor_size", "mirrors", "margin", "threshold_px", "corners")
    options = {name: cfg[name] for name in names}
    aligned = calibrations.align_views(cfg.recording, run, build.part(cfg, "target"), **options)
    if cfg.save:
        aligned.save(cfg.save)
    return {f"error_px of {view.position}": round(view.error_px, 3) for view in aligned.views}


def threshold(cfg: DictConfig, run: Path) -> dict:
    """Find the contrast threshold by comparing event rates with the configured simulation's."""
    pipeline = build.pipeline(cfg, "test")
    clips = [pipeline.views(pipeline.draw(index))[0] for index in range(cfg.clips)]
    estimate = calibrations.find_threshold(
        cfg.recording, run, clips, cfg.fps * cfg.data.substeps, pipeline.sensor,
        views=cfg.views, sensor_size=cfg.sensor_size,
    )  # fmt: skip
    return {"ON (value, low, high)": estimate.on, "OFF": estimate.off}


def turbulence(cfg: DictConfig, run: Path) -> dict:
    """Measure tilt, blur and scintillation of a dot grid against the same without turbulence."""
    network = build.chosen(cfg) if cfg.ckpt or cfg.get("baseline") else None
    statistics = calibrations.characterise(
        cfg.recording, cfg.still, run, fps=cfg.fps, network=network, views=cfg.views,
        sensor_size=cfg.sensor_size, **cfg.dots,
    )  # fmt: skip
    return statistics.summary()


def air(cfg: DictConfig, run: Path) -> dict:
    """Measure the air in front of a still scene: `air.yaml`, also at `cfg.save`."""
    if OmegaConf.is_missing(cfg, "video"):
        raise ValueError("video must be a film of a still scene, got none")
    measured = calibrations.measure_air(cfg.video, run, fps=cfg.fps, save=cfg.save, **cfg.air)
    return {name: str(value) for name, value in vars(measured.found).items()}


TASKS = {"views": views, "threshold": threshold, "turbulence": turbulence, "air": air}
FPS = 120.0  # where `fps` is null and the task needs one


def calibrate(cfg: DictConfig) -> dict:
    """Do `cfg.task`; everything goes below `cfg.paths.run`.  Raises ValueError for another task."""
    if cfg.task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}, got {cfg.task}")
    if cfg.fps is None and cfg.task != "air":
        cfg.fps = FPS
    run = Path(cfg.paths.run)
    results.open_run(run, door.resolved(cfg))
    summary = TASKS[cfg.task](cfg, run)
    rich.print(summary, f"in {run}")
    return summary


@hydra.main(version_base=None, config_path="../conf", config_name="calibrate")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `calibrate`."""
    door.job(calibrate, cfg)


if __name__ == "__main__":
    door.run(main)
