"""Videos under each other with a slice of each: python -m src.compare videos=[a.h5,b.h5] line=...

The layout of the paper's figures 6 to 10: samples, an x-t, r-t or theta-t slice, its strayings.
"""

import math
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

    Straightness is that of uniform motion along a line, or of uniform turning along a circle.
    Raises ValueError for a video that cannot be read or is of another size than the first, or a
    slice that leaves the picture.
    """
    run = Path(cfg.paths.run)
    names = list(cfg.names or [Path(path).parent.name for path in cfg.videos])
    if len(names) != len(cfg.videos):
        raise ValueError(f"names must be one per video, got {len(names)} for {len(cfg.videos)}")
    films = [np.stack(list(sources.film(path)))[cfg.first : cfg.last] for path in cfg.videos]
    sizes = {film.shape[1:] for film in films}
    if len(sizes) > 1:
        raise ValueError(f"videos must be of one size (h, w), got {sorted(sizes)}")
    results.open_run(run, door.resolved(cfg))
    found, rows = {}, []
    for name, film in zip(names, films, strict=True):
        across, points = cut(cfg, film)
        strays = paths.turning if cfg.circle else paths.straightness
        found[name] = {"wander": paths.wander(across), "straightness": strays(across)}
        note = f"wander {found[name]['wander']:.2f}, from a line {found[name]['straightness']:.2f}"
        rows.append(layouts.Row(name, film, across, note))
    shortest = min(map(len, films))
    layouts.comparison(
        rows, run / "comparison.png", line=points, length_s=shortest / cfg.fps, axis=cfg.axis,
        samples=np.linspace(0, shortest - 1, cfg.samples).astype(int).tolist(),
    )  # fmt: skip
    rich.print(found, f"in {run}")
    return found


def cut(cfg: DictConfig, film: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slice (frames, places) and its points in the first frame: `line` [[x, y], [x, y]],
    `circle` [x, y, radius] or `spin` [x, y, radius, turns a second, degrees at the first frame].
    """
    if sum(bool(given) for given in (cfg.line, cfg.circle, cfg.spin)) != 1:
        raise ValueError(
            f"give one of line, circle and spin, got {cfg.line}, {cfg.circle}, {cfg.spin}"
        )
    if cfg.spin:
        x, y, radius, turns, degrees = cfg.spin
        angles = math.radians(degrees) + 2 * math.pi * turns * np.arange(len(film)) / cfg.fps
        end = (x + radius * math.cos(angles[0]), y + radius * math.sin(angles[0]))
        radii = np.arange(0, radius + 1e-9)
        return slices.along(film, (x, y), angles, radii), slices.line((x, y), end)
    points = (
        slices.line(*map(tuple, cfg.line))
        if cfg.line
        else slices.circle(tuple(cfg.circle[:2]), cfg.circle[2])
    )
    return slices.sample(film, points), points


@hydra.main(version_base=None, config_path="../conf", config_name="compare")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `compare`."""
    door.job(compare, cfg)


if __name__ == "__main__":
    door.run(main)
