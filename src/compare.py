"""Videos under each other with a slice of each: python -m src.compare videos=[a.h5,b.h5] line=...

The layout of the paper's figures 6 to 10: samples, an x-t, r-t or theta-t slice, its strayings.
"""

import math
from pathlib import Path

import hydra
import numpy as np
import rich
from omegaconf import DictConfig

from src.app import door
from src.figures import layouts, slices
from src.metrics import straightness
from src.recordings.files import sources
from src.records import results

NOTES = {
    "wander": "wander of what stands still: {:.2f} px",
    "straightness": "what moves, from a line: {:.2f} px",
    "contrast": "contrast: {:.3f}",
}


def compare(cfg: DictConfig) -> dict:
    """Write `comparison.png`.  Returns how far what each video's slice shows strays, in pixels.

    `wander`, along a line or a ray that turns with the scene, is of what stands still there,
    `straightness` of what moves uniformly along a line or a circle.  With `still` the whole scene
    stands: wander is the median over its rows and columns, `contrast` its pictures' deviation.
    Raises ValueError for a video that cannot be read or is of another size than the first, or a
    slice that leaves the picture.
    """
    run = Path(cfg.paths.run)
    names = list(cfg.names or [Path(path).parent.name for path in cfg.videos])
    if len(names) != len(cfg.videos):
        raise ValueError(f"names must be one per video, got {len(names)} for {len(cfg.videos)}")
    films = [np.stack(list(sources.film(path)))[cfg.first : cfg.last] for path in cfg.videos]
    films = slices.shrunk(films) if cfg.still else films
    sizes = {film.shape[1:] for film in films}
    if len(sizes) > 1:
        raise ValueError(f"videos must be of one size (h, w), got {sorted(sizes)}")
    results.open_run(run, door.resolved(cfg))
    found, rows = {}, []
    for name, film in zip(names, films, strict=True):
        across, points = cut(cfg, film)
        found[name] = strays(cfg, across) if not cfg.still else stands(film, cfg.still)
        notes = [NOTES[measure].format(value) for measure, value in found[name].items()]
        rows.append(layouts.Row(name, film, across, "\n".join(notes)))
    shortest = min(map(len, films))
    layouts.comparison(
        rows, run / "comparison.png", line=points, length_s=shortest / cfg.fps, axis=cfg.axis,
        samples=np.linspace(0, shortest - 1, cfg.samples).astype(int).tolist(),
    )  # fmt: skip
    rich.print(found, f"in {run}")
    return found


def cut(cfg: DictConfig, film: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slice (frames, places) and its points in the first frame: `line` [[x, y], [x, y]],
    `circle` [x, y, radius] or `spin` [x, y, radius, turns a second, degrees at the first frame];
    of a `still` scene the middle row.
    """
    given = {name: cfg[name] for name in ("line", "circle", "spin", "still") if cfg[name]}
    if len(given) != 1:
        raise ValueError(f"give one of line, circle, spin and still, got {given or 'none'}")
    if cfg.still:
        middle = film.shape[1] // 2
        return film[:, middle], slices.line((0, middle), (film.shape[2] - 1, middle))
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


def strays(cfg: DictConfig, across: np.ndarray) -> dict[str, float]:
    """Return `wander` and `straightness` of the slice `across` (frames, places), in pixels.

    Nothing stands still on a circle, and nothing moves along a ray that turns with the scene.
    """
    found = {}
    if not cfg.circle:
        found["wander"] = straightness.wander(across)
    if not cfg.spin:
        measure = straightness.turning if cfg.circle else straightness.straightness
        found["straightness"] = measure(followed(across, cfg.follow))
    return found


def stands(film: np.ndarray, step: int) -> dict[str, float]:
    """Return `wander`, the median over lines `step` pixels apart, in pixels, and `contrast`."""
    found = {"wander": straightness.wander_of_all(film, step)}
    return found | {"contrast": float(film.std((1, 2)).mean())}


def followed(across: np.ndarray, follow: str) -> np.ndarray:
    """Return `across` with nothing in it but what is `bright` or `dark` against the median in time;
    with `any`, as it is.  Raises ValueError for another word."""
    middle = np.median(across, axis=0)
    kinds = {
        "any": across,
        "bright": np.maximum(across, middle),
        "dark": np.minimum(across, middle),
    }
    if follow not in kinds:
        raise ValueError(f"follow must be one of {', '.join(kinds)}, got {follow}")
    return kinds[follow]


@hydra.main(version_base=None, config_path="../conf", config_name="compare")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `compare`."""
    door.job(compare, cfg)


if __name__ == "__main__":
    door.run(main)
