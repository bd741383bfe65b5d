"""Frames of a camera beside the event pixels (a DAVIS), against a reconstruction of the events."""

from pathlib import Path

import numpy as np
import torch

from src.metrics.image import align_brightness, ssim
from src.metrics.lpips import LPIPS
from src.metrics.slice_motion import correlation
from src.recordings.files import videos
from src.recordings.files.frame_files import read_frame_list

NAMES = ("ssim", "lpips", "lpips_aligned", "correlation")
SETTLING = 2  # first frames of a reconstruction, which are not looked at


def score_against_camera(
    video: Path, listing: Path, part: slice = slice(None), most: int | None = None
) -> dict[str, float]:
    """Return the mean scores NAMES of `part` of a video of src.reconstruct, its first `most` frames
    (None: all), with a camera's frames, each against the frame nearest in time; `lpips_aligned` is
    after the best gain and offset of each frame, as events carry neither.  A frame without contrast
    has correlation 0.

    `listing`: a line per picture, seconds and file.  Raises ValueError as `check_camera_frames`
    does, and where no picture falls on a frame.
    """
    table = check_camera_frames(video, listing)
    film, scores, lpips = list(videos.read_video(video)), [], LPIPS()
    clock = _read_clock(video, table, len(film))
    scored = range(len(film))[part][:most]
    reach = 0.5 * float(np.diff(clock).max(initial=0.0))
    for second, name in read_frame_list(listing, "reference_images"):
        nearest = int(np.abs(clock - second).argmin())
        is_near = abs(clock[nearest] - second) <= reach
        if is_near and nearest >= SETTLING and nearest in scored:
            truth = next(videos.read_video(name))
            if truth.shape != film[nearest].shape:
                sizes = f"{film[nearest].shape}, got {truth.shape} in {name}"
                raise ValueError(f"reference_images must have the video's size (h, w) {sizes}")
            a, b = (torch.from_numpy(p.copy())[None, None] for p in (film[nearest], truth))
            aligned = align_brightness(a, b).clamp(0, 1)
            together = correlation(film[nearest], truth)
            scores.append(
                [ssim(a, b).item(), lpips(a, b).item(), lpips(aligned, b).item(), together]
            )
    if not scores:
        wanted = "reference_images must have frames within the video's time"
        raise ValueError(f"{wanted}, {listing} has none")
    return dict(zip(NAMES, np.mean(scores, 0).tolist(), strict=True))


def check_camera_frames(video: Path, listing: Path) -> Path:
    """Return the table `frames.csv` of a video; raises ValueError where it or `listing` is not
    there."""
    table = video.parent / "frames.csv"
    if not table.is_file() or not listing.is_file():
        missing = table if listing.is_file() else listing
        wanted = "reference_images must be the list of a camera's frames"
        raise ValueError(f"{wanted}, {missing} is not there")
    return table


def _read_clock(video: Path, table: Path, frames: int) -> np.ndarray:
    """Return the seconds of the frames: those of a `video.h5`, else of the table `frames.csv`."""
    clock = videos.read_times(video)
    if clock is None:
        clock = np.loadtxt(table, delimiter=",", skiprows=1, usecols=1, ndmin=1)
    if len(clock) != frames:
        counts = f"{len(clock)} lines for {frames} frames of {video}"
        raise ValueError(f"reference_images: {table} is of another video, {counts}")
    return clock
