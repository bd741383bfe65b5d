"""Videos under each other with a slice of each: python -m src.compare videos=[a.h5,b.h5] line=...

The layout of the paper's figures 6, 9 and 11: samples, an x-t, r-t or theta-t slice, deviations.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
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
LARGEST_NUMBER = 1e5  # of a slice: pixels, turns a second, degrees
MOST_SHOWN = 100
NOTES = {
    "residual_displacement_px": ("residual displacement, if static", "{:.2f} px"),
    "line_deviation_px": ("deviation from a line, if moving", "{:.2f} px"),
    "contrast": ("contrast", "{:.3f}"),
    "flicker": ("change from frame to frame", "{:.3f} of the contrast"),
    "ssim": ("SSIM with the camera", "{:.3f}"),
    "lpips": ("LPIPS", "{:.3f}"),
    "lpips_aligned": ("LPIPS, brightness and contrast aligned", "{:.3f}"),
    "correlation": ("correlation", "{:.3f}"),
}  # a measure in words, and its value


def compare(cfg: DictConfig) -> dict:
    """Write `comparison.png`; return the motion measures of each video's slice, in pixels.

    `residual_displacement_px`, along a line or a ray that turns with the scene, is of what is
    static there, `line_deviation_px` of what moves uniformly along a line or a circle.  With
    `still` the whole scene is static (`slice_motion.measure_static_scene`).  Raises ValueError for
    a video that cannot be read, has fewer than two frames from `first` to `last`, another size than
    the first (with `still`: another aspect ratio) or another frame rate than `fps`, or a slice
    outside the frame.
    """
    run = Path(cfg.paths.run)
    check_slice(cfg)
    check_videos(cfg)
    names = _name_videos(cfg)
    _check_frame_rate(cfg)
    kind, (films, start_s) = _chosen_slice(cfg), _read_films(cfg, names)
    cuts = [slices.cut_slice(film, fps=cfg.fps, **{kind: cfg[kind]}) for film in films]
    scores, rows = {}, []
    for name, path, film, (across, _) in zip(names, cfg.videos, films, cuts, strict=True):
        camera = _score_against_camera(cfg, Path(path), len(film))
        scores[name] = _measure(film, across, cfg, kind) | camera
        rows.append(comparison.VideoRow(name, film, across, _format_note(scores[name])))
    with results.store_config_when_done(run, entry_point.resolved_yaml(cfg)):
        _draw(rows, run / "comparison.png", cfg, kind, line=cuts[0][1], start_s=start_s)
    for row in rows:
        print(f"{row.name}: {'; '.join(row.note.splitlines())}")
    print(f"in {run}")
    return scores


def _name_videos(cfg: DictConfig) -> list[str]:
    names = list(cfg.names or default_video_names([Path(path) for path in cfg.videos]))
    if len(names) != len(cfg.videos):
        raise ValueError(f"names must be one per video, got {len(names)} for {len(cfg.videos)}")
    if len(set(names)) < len(names):
        raise ValueError(f"names must differ, got {', '.join(names)}")
    return names


def _check_frame_rate(cfg: DictConfig) -> None:
    for path in cfg.videos:
        own = videos.read_fps(path, "videos") if Path(path).suffix == ".h5" else None
        if own is not None and not math.isclose(own, cfg.fps, rel_tol=0.01):
            raise ValueError(f"fps must be that of {path}, {own:g}, got {cfg.fps}")


def _read_films(cfg: DictConfig, names: Sequence[str]) -> tuple[list[np.ndarray], float]:
    """Return the frames `first` to `last` of every video, of one size and number, and the time in s
    of the first video's `first`."""
    films, starts = {}, []
    for name, path in zip(names, cfg.videos, strict=True):
        film = np.stack(list(videos.read_video(path, "videos")))
        films[name] = _cut_part(film, cfg.first, cfg.last, name)
        starts.append(slice(cfg.first, cfg.last).indices(len(film))[0])
    lengths = {name: len(film) for name, film in films.items()}
    if (common := min(lengths.values())) < max(lengths.values()):
        listed = ", ".join(f"{name} {count}" for name, count in lengths.items())
        print(f"the first {common} of these frames of each are compared: {listed}")
        films = {name: film[:common] for name, film in films.items()}
    if cfg.still is not None:
        films = slices.shrink_to_smallest(films)
    sizes = {film.shape[1:] for film in films.values()}
    if len(sizes) > 1:
        raise ValueError(f"videos must be of one size (h, w), got {sorted(sizes)}")
    return list(films.values()), starts[0] / cfg.fps


def _cut_part(film: np.ndarray, first: int, last: int | None, name: str) -> np.ndarray:
    part = film[first:last]
    if len(part) < 2:
        got = f"{first} and {'null' if last is None else last}"
        why = f"{name} has {len(film)} frame{'s' * (len(film) != 1)}"
        raise ValueError(f"first and last must leave two frames or more, got {got}: {why}")
    return part


def _chosen_slice(cfg: DictConfig) -> str:
    given = {name: cfg[name] for name in slices.KINDS if cfg[name] is not None}
    if len(given) != 1:
        raise ValueError(f"give one of line, circle, spin and still, got {given or 'none'}")
    return next(iter(given))


def _measure(film: np.ndarray, across: slices.Slice, cfg: DictConfig, kind: str) -> dict:
    if kind == "still":
        return slice_motion.measure_static_scene(film, cfg.still)
    return slice_motion.measure_slice_motion(across, kind, cfg.moving_object_brightness)


def _score_against_camera(cfg: DictConfig, video: Path, frames: int) -> dict:
    if not cfg.reference_images:
        return {}
    part = slice(cfg.first, cfg.last)
    return camera_frames.score_against_camera(video, Path(cfg.reference_images), part, frames)


def _format_note(scores: dict) -> str:
    """Return a line for each measure; a dash for one that the videos do not show."""
    lines = []
    for measure, value in scores.items():
        name, form = NOTES[measure]
        lines.append(f"{name}: {'-' if math.isnan(value) else form.format(value)}")
    return "\n".join(lines)


def _draw(
    rows: Sequence[comparison.VideoRow], path: Path, cfg: DictConfig, kind: str,
    line: slices.Points, start_s: float,
) -> None:  # fmt: skip
    comparison.draw_comparison(
        rows, path, line=line, axis=slices.name_axis(kind, line), samples=cfg.frames_shown,
        frame_s=1 / cfg.fps, start_s=start_s,
    )  # fmt: skip


def default_video_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of the folders, with those of the files where folders are alike."""
    folders = [path.parent.name for path in paths]
    if len(set(folders)) == len(folders):
        return folders
    return [f"{path.parent.name}/{path.stem}" for path in paths]


def check_videos(cfg: DictConfig) -> None:
    """Raise ValueError for videos, names or a list of a camera's frames that cannot be used."""
    for key in ("videos", "names"):
        if any(not isinstance(name, str) for name in cfg[key] or ()):
            raise ValueError(f"{key} must be a list of words, got {cfg[key]}")
    if not cfg.videos:
        raise ValueError("videos must name one file or more, got []")
    for path in map(Path, cfg.videos):
        if not path.exists():
            raise ValueError(f"videos must be films or folders of pictures that exist, got {path}")
        if cfg.reference_images:
            camera_frames.check_camera_frames(path, Path(cfg.reference_images))


def check_slice(cfg: DictConfig) -> None:
    """Raise ValueError for an `fps`, a number of frames or a slice of another form than
    `cut_slice` takes, or unless one slice is given."""
    if not 0 < cfg.fps < math.inf:
        raise ValueError(f"fps must be > 0 frames a second, got {cfg.fps}")
    for key, form in FORMS.items():
        try:
            given = np.array(form if cfg[key] is None else OmegaConf.to_object(cfg[key]))
        except ValueError:  # rows of several lengths
            given = np.empty(0, str)
        if given.dtype.kind not in "if" or given.shape != np.shape(form):
            raise ValueError(f"{key} must be numbers as in {form}, got {cfg[key]}")
        if not np.abs(given).max() <= LARGEST_NUMBER:
            allowed = f"[-{LARGEST_NUMBER:g}, {LARGEST_NUMBER:g}]"
            raise ValueError(f"{key} must have numbers in {allowed}, got {cfg[key]}")
        if key == "line" and (given[0] == given[1]).all():
            raise ValueError(f"line must have two ends that differ, got {cfg.line}")
        if key != "line" and not given[2] >= 1:
            raise ValueError(f"{key} must have a radius of 1 pixel or more, got {cfg[key]}")
    if isinstance(cfg.still, float):
        raise ValueError(f"still must be a whole number of pixels or null, got {cfg.still}")
    _chosen_slice(cfg)
    if not 1 <= cfg.frames_shown <= MOST_SHOWN:
        raise ValueError(f"frames_shown must be in 1..{MOST_SHOWN}, got {cfg.frames_shown}")


if __name__ == "__main__":
    entry_point.run_command(compare, "compare")
