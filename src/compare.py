"""Videos under each other with a slice of each: python -m src.compare videos=[a.h5,b.h5] line=...

The layout of the paper's figures 6 to 10: samples, an x-t, r-t or theta-t slice, its strayings.
"""

from pathlib import Path

import hydra
import numpy as np
import rich
from omegaconf import DictConfig

from src.app import door
from src.figures import comparison, slices
from src.metrics import slice_motion
from src.recordings import camera_frames
from src.recordings.files import sources
from src.records import results

NOTES = {
    "wander": "wander of what stands still: {:.2f} px",
    "straightness": "what moves, from a line: {:.2f} px",
    "contrast": "contrast: {:.3f}",
    "flicker": "change from frame to frame: {:.3f} of the contrast",
    "ssim": "SSIM with the camera: {:.3f}",
    "lpips": "LPIPS: {:.3f}",
    "correlation": "correlation: {:.3f}",
}


def compare(cfg: DictConfig) -> dict:
    """Write `comparison.png`.  Returns how far what each video's slice shows strays, in pixels.

    `wander`, along a line or a ray that turns with the scene, is of what stands still there,
    `straightness` of what moves uniformly along a line or a circle.  With `still` the whole scene
    stands (`slice_motion.of_still`).  Raises ValueError for a video that cannot be read or is of
    another size than the first, or a slice that leaves the picture.
    """
    run = Path(cfg.paths.run)
    if not cfg.videos:
        raise ValueError("videos must name one file or more, got []")
    names = list(cfg.names or [Path(path).parent.name for path in cfg.videos])
    if len(names) != len(cfg.videos):
        raise ValueError(f"names must be one per video, got {len(names)} for {len(cfg.videos)}")
    films = [np.stack(list(sources.film(path)))[cfg.first : cfg.last] for path in cfg.videos]
    given = {name: cfg[name] for name in slices.KINDS if cfg[name]}
    if len(given) != 1:
        raise ValueError(f"give one of line, circle, spin and still, got {given or 'none'}")
    films = slices.shrunk(films) if cfg.still else films
    sizes = {film.shape[1:] for film in films}
    if len(sizes) > 1:
        raise ValueError(f"videos must be of one size (h, w), got {sorted(sizes)}")
    results.open_run(run, door.resolved(cfg))
    scores, rows = {}, []
    for name, path, film in zip(names, cfg.videos, films, strict=True):
        across, points = slices.cut(film, fps=cfg.fps, **given)
        if cfg.still:
            scores[name] = slice_motion.of_still(film, cfg.still)
        else:
            scores[name] = slice_motion.of_slice(across, next(iter(given)), cfg.follow)
        if cfg.camera:
            scores[name] |= camera_frames.agreement(Path(path), Path(cfg.camera))
        notes = [NOTES[measure].format(value) for measure, value in scores[name].items()]
        rows.append(comparison.Row(name, film, across, "\n".join(notes)))
    shortest = min(map(len, films))
    comparison.comparison(
        rows, run / "comparison.png", line=points, length_s=shortest / cfg.fps, axis=cfg.axis,
        samples=np.linspace(0, shortest - 1, cfg.samples).astype(int).tolist(),
    )  # fmt: skip
    rich.print(scores, f"in {run}")
    return scores


@hydra.main(version_base=None, config_path="../conf", config_name="compare")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `compare`."""
    door.job(compare, cfg)


if __name__ == "__main__":
    door.run(main)
