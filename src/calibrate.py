"""Calibrate: python -m src.calibrate task=views|threshold|turbulence recording=..."""

from pathlib import Path

import hydra
import numpy as np
import rich
from omegaconf import DictConfig

from src import build, door
from src.figures import calibration
from src.metrics import results
from src.recordings import alignment, dots, lookup, sources, statistics, stream, views


def align(cfg: DictConfig, run: Path) -> None:
    """Find the views and write `views.yaml`, `views.png`; of a failure `found.png` remains."""
    picture = alignment.picture_of(sources.sensor_picture(cfg.recording, cfg.sensor_size))
    sizes = {"sensor": picture.shape, "model": tuple(cfg.resolution)}
    if cfg.corners:
        found = alignment.by_hand(alignment.read_corners(cfg.corners), **sizes)
        calibration.views_by_hand(picture, found, run / "views.png")
    else:
        seen = alignment.find(picture, build.make(cfg.target), cfg.mirrors)
        calibration.views_found(picture, seen, run / "found.png")
        aligned = alignment.align(seen, margin=cfg.margin, threshold_px=cfg.threshold_px, **sizes)
        calibration.views_aligned(picture, aligned, run / "views.png")
        found = aligned.views
    for path in filter(None, (run / "views.yaml", cfg.save)):
        found.save(path)
    errors = {str(view.position): round(view.error_px, 3) for view in found.views}
    rich.print("reprojection error in pixels", errors, f"in {run}")


def characterise(cfg: DictConfig, run: Path) -> None:
    """Write `turbulence.png` and `turbulence.csv` of a dot grid with and without turbulence."""
    there = views.load(cfg.views) if cfg.views else None
    positions = there.positions if there else [(0, 0)]
    still, turbulent = (registered(cfg, path, there) for path in (cfg.still, cfg.recording))
    centre = positions.index((0, 0))
    grid = cfg.dots
    places = statistics.find_dots(still[centre].mean(0), grid.rows, grid.cols, grid.dark)
    radius = grid.radius or statistics.radius(places)
    fits = [[dots.fit(film, places, radius) for film in films] for films in (turbulent, still)]
    found = statistics.measure(*fits, fps=cfg.fps, centre=centre)
    statistics.write_csv(found, run / "turbulence.csv", positions)
    calibration.turbulence(found, positions, run / "turbulence.png")
    rich.print(found.summary(), f"in {run}")


def registered(cfg: DictConfig, path: str, there: views.Views | None) -> np.ndarray:
    """Return (views, frames, h, w) of a film, or of a recording reconstructed view by view."""
    if not sources.holds_events(path):
        frames = [there.register(frame) if there else frame[None] for frame in sources.film(path)]
        return np.stack(frames, axis=1)
    sensor = sources.sensor_size(path, cfg.sensor_size)
    overlap = stream.overlap("trained", cfg.fps)
    rule = stream.Rule(fps=cfg.fps, overlap=overlap, bins=cfg.bins)
    table = lookup.build(there or views.Views.single(sensor, sensor))
    windows = stream.windows(sources.events(path, sensor), table, rule)
    return np.stack(list(stream.each_view(windows, build.chosen(cfg), overlap=overlap)), axis=1)


TASKS = {"views": align, "turbulence": characterise}


def calibrate(cfg: DictConfig) -> None:
    """Do `cfg.task`; everything goes below `cfg.paths.run`.  Raises ValueError for another task."""
    if cfg.task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}, got {cfg.task}")
    run = Path(cfg.paths.run)
    results.open_run(run, door.resolved(cfg))
    TASKS[cfg.task](cfg, run)


@hydra.main(version_base=None, config_path="../conf", config_name="calibrate")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `calibrate`."""
    door.job(calibrate, cfg)


if __name__ == "__main__":
    door.run(main)
