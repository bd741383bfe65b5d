"""Videos under each other with a slice of each: python -m src.compare videos=[a.h5,b.h5] line=...

The layout of the paper's figures 6 to 10: samples, an x-t, r-t or theta-t slice, its strayings.
"""

from pathlib import Path

import hydra
import numpy as np
import rich
from omegaconf import DictConfig

from src import door
from src.figures import layouts, slices
from src.metrics import paths, results
from src.recordings import sources


def compare(cfg: DictConfig) -> dict:
    """Write `comparison.png`.  Returns wander and straightness of each video in places.

    Raises ValueError for a video that cannot be read, or a slice that leaves the picture.
    """
    run, points = Path(cfg.paths.run), places(cfg)
    names = list(cfg.names or [Path(path).parent.name for path in cfg.videos])
    if len(names) != len(cfg.videos):
        raise ValueError(f"names must be one per video, got {len(names)} for {len(cfg.videos)}")
    films = [np.stack(list(sources.film(path)))[cfg.first : cfg.last] for path in cfg.videos]
    results.open_run(run, door.resolved(cfg))
    found, rows = {}, []
    for name, film in zip(names, films, strict=True):
        across = slices.sample(film, points)
        found[name] = {"wander": paths.wander(across), "straightness": paths.straightness(across)}
        note = f"wander {found[name]['wander']:.2f}, from a line {found[name]['straightness']:.2f}"
        rows.append(layouts.Row(name, film, across, note))
    shortest = min(map(len, films))
    layouts.comparison(
        rows, run / "comparison.png", line=points, length_s=shortest / cfg.fps, axis=cfg.axis,
        samples=np.linspace(0, shortest - 1, cfg.samples).astype(int).tolist(),
    )  # fmt: skip
    rich.print(found, f"in {run}")
    return found


def places(cfg: DictConfig) -> np.ndarray:
    """Return the points of the slice: `line` [[x, y], [x, y]] or `circle` [x, y, radius]."""
    if bool(cfg.line) == bool(cfg.circle):
        raise ValueError(f"give either line or circle, got {cfg.line} and {cfg.circle}")
    if cfg.line:
        return slices.line(*map(tuple, cfg.line))
    return slices.circle(tuple(cfg.circle[:2]), cfg.circle[2])


@hydra.main(version_base=None, config_path="../conf", config_name="compare")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `compare`."""
    door.job(compare, cfg)


if __name__ == "__main__":
    door.run(main)
