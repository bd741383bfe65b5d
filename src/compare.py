"""Videos under each other with a slice of each: python -m src.compare videos=[a.h5,b.h5] line=...

The layout of the paper's figures 6, 9 and 11: samples, an x-t, r-t or theta-t slice, deviations.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rich
from omegaconf import DictConfig, OmegaConf

from src.app import entry_point
from src.figures import comparison, slices
from src.metrics import slice_motion
from src.recordings import camera_frames
from src.recordings.files import videos
from src.records import results

FORMS: dict[str, list] = {
    "line": [[0, 88], [175, 88]], "circle": [88, 88, 40], "spin": [88, 88, 40, 2.5, 90],
}  # fmt: skip
NOTES = {
    "residual_displacement_px": "residual displacement, static: {:.2f} px",
    "line_deviation_px": "deviation from a line, moving: {:.2f} px",
    "contrast": "contrast: {:.3f}",
    "flicker": "change from frame to frame: {:.3f} of the contrast",
    "ssim": "SSIM with the camera: {:.3f}",
    "lpips": "LPIPS: {:.3f}",
    "lpips_aligned": "LPIPS, brightness and contrast aligned: {:.3f}",
    "correlation": "correlation: {:.3f}",
}


def compare(cfg: DictConfig) -> dict:
    """Write `comparison.png`; return the motion measures of each video's slice, in pixels.

    `residual_displacement_px`, along a line or a ray that turns with the scene, is of what is
    static there, `line_deviation_px` of what moves uniformly along a line or a circle.  With
    `still` the whole scene is static (`slice_motion.measure_static_scene`).  Raises ValueError for
    a video that cannot be read or has another size than the first, or a slice outside the frame.
    """
    run = Path(cfg.paths.run)
    if not cfg.videos:
        raise ValueError("videos must name one file or more, got []")
    check_slice(cfg)
    names = list(cfg.names or default_video_names([Path(path) for path in cfg.videos]))
    if len(names) != len(cfg.videos):
        raise ValueError(f"names must be one per video, got {len(names)} for {len(cfg.videos)}")
    if len(set(names)) < len(names):
        raise ValueError(f"names must differ, got {', '.join(names)}")
    read = (np.stack(list(videos.read_video(path, "videos"))) for path in cfg.videos)
    films = [film[cfg.first : cfg.last] for film in read]
    given = {name: cfg[name] for name in slices.KINDS if cfg[name]}
    if len(given) != 1:
        raise ValueError(f"give one of line, circle, spin and still, got {given or 'none'}")
    films = slices.shrink_to_smallest(films) if cfg.still else films
    sizes = {film.shape[1:] for film in films}
    if len(sizes) > 1:
        raise ValueError(f"videos must be of one size (h, w), got {sorted(sizes)}")
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    scores, rows = {}, []
    for name, path, film in zip(names, cfg.videos, films, strict=True):
        across, points = slices.cut_slice(film, fps=cfg.fps, **given)
        if cfg.still:
            scores[name] = slice_motion.measure_static_scene(film, cfg.still)
        else:
            scores[name] = slice_motion.measure_slice_motion(
                across, next(iter(given)), cfg.moving_object_brightness
            )
        if cfg.reference_images:
            scores[name] |= camera_frames.score_against_camera(
                Path(path), Path(cfg.reference_images), slice(cfg.first, cfg.last)
            )
        notes = [NOTES[measure].format(value) for measure, value in scores[name].items()]
        rows.append(comparison.VideoRow(name, film, across, "\n".join(notes)))
    comparison.draw_comparison(
        rows, run / "comparison.png", line=points, axis=cfg.axis_label, samples=cfg.frames_shown,
        length_s=min(map(len, films)) / cfg.fps,
    )  # fmt: skip
    rich.print(scores, f"in {run}")
    return scores


def default_video_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of the folders, with those of the files where folders are alike."""
    folders = [path.parent.name for path in paths]
    if len(set(folders)) == len(folders):
        return folders
    return [f"{path.parent.name}/{path.stem}" for path in paths]


def check_slice(cfg: DictConfig) -> None:
    """Raise ValueError for an `fps` or a slice of another form than cut_slice takes."""
    if not 0 < cfg.fps < math.inf:
        raise ValueError(f"fps must be > 0 frames a second, got {cfg.fps}")
    for key, form in FORMS.items():
        try:
            given = np.array(OmegaConf.to_object(cfg[key]) if cfg[key] else form)
        except ValueError:  # rows of several lengths
            given = np.empty(0, str)
        if given.dtype.kind not in "if" or given.shape != np.shape(form):
            raise ValueError(f"{key} must be numbers as in {form}, got {cfg[key]}")


if __name__ == "__main__":
    entry_point.run_command(compare, "compare")
