"""Frames of a camera beside the event pixels (a DAVIS), against a reconstruction of the events."""

from pathlib import Path

import numpy as np
import torch

from src.metrics.image import align_brightness, ssim
from src.metrics.lpips import LPIPS
from src.metrics.slice_motion import correlation
from src.recordings.files import videos

NAMES = ("ssim", "lpips", "lpips_aligned", "correlation")
SETTLING = 2  # first frames of a reconstruction, which are not looked at


def score_against_camera(video: Path, listing: Path, part: slice = slice(None)) -> dict[str, float]:
    """Return the mean scores NAMES of `part` of a video of src.reconstruct with a camera's frames,
    each against the frame nearest in time; `lpips_aligned` is after the best gain and offset of
    each frame, as events carry neither.  A frame without contrast has correlation 0.

    `listing`: a line per picture, seconds and file.  Raises ValueError without the video's
    `frames.csv`, or where no picture falls on a frame.
    """
    table = video.parent / "frames.csv"
    if not table.is_file() or not listing.is_file():
        missing = table if listing.is_file() else listing
        wanted = "reference_images must be the list of a camera's frames"
        raise ValueError(f"{wanted}, {missing} is not there")
    clock = np.loadtxt(table, delimiter=",", skiprows=1, usecols=1, ndmin=1)
    film, scores, lpips = list(videos.read_video(video)), [], LPIPS()
    scored = range(len(film))[part]
    reach = 0.5 * float(np.diff(clock).max(initial=0.0))
    for line in listing.read_text().splitlines():
        second, name = line.split()
        nearest = int(np.abs(clock - float(second)).argmin())
        is_near = abs(clock[nearest] - float(second)) <= reach
        if is_near and nearest >= SETTLING and nearest in scored:
            truth = next(videos.read_video(listing.parent / name))
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
