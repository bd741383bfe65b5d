"""Stress test of fast motion: whether a target on a straight trajectory is reconstructed on it."""

from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import ClipConditions, EventClip, Film, StressBench
from src.bench.stress_tests.stress_results import StressResult

LAG_FRAMES = 6  # over which brightening is measured
GATE_PX = 24.0  # around the true front
MARGIN_PX = 12.0  # from the frame's border, within which the true front does not count
WARMUP_FRAMES = 32  # until the target has left its first place, which no event tells


def measure_trajectory_deviation(
    network: Candidate, bench: StressBench, *, limit_px: float
) -> StressResult:
    """Return the rms distance, in pixels, of the front of a flying target from its line, across it;
    the mean over clips of one target.

    The front is the centroid of what has become brighter in the last frames near where it truly is.
    The curve begins with the network's mean without turbulence and that of the light of one view.
    """

    def deviation(clip: EventClip) -> float:
        return measure_cross_track_error_px(clip.reconstruct(network)[0][:, 0], clip.target[1:])

    clips = bench.clips()
    without = fmean(map(deviation, bench.clips(ClipConditions(d_over_r0=0.0))))
    light = fmean(measure_cross_track_error_px(c.turbulent[1:], c.target[1:]) for c in clips)
    deviations = list(map(deviation, clips))
    named = [(f"clip {n}", d) for n, d in zip(bench.indices, deviations, strict=True)]
    curve = [("no turbulence", without), ("light of one view", light), *named]
    return StressResult(fmean(deviations), "px", limit_px, curve, "video")


def measure_cross_track_error_px(frames: Film, truth: Film) -> float:
    """Return the rms distance, in pixels, of the front in `frames` from its line in `truth`.

    Raises ValueError for fewer than four frames that count.
    """
    risen, true = (
        (film[LAG_FRAMES:] - film[:-LAG_FRAMES]).clamp(min=0) for film in (frames, truth)
    )
    known = _centroids(true)
    most = torch.tensor(truth.shape[:0:-1]) - 1.0 - MARGIN_PX
    counts = ((known > MARGIN_PX) & (known < most)).all(1)
    counts[:WARMUP_FRAMES] = False
    if counts.sum() < 4:
        raise ValueError(f"data.test_windows must show more of a flight, got {counts.sum()} frames")
    known, risen = known[counts], risen[counts]
    y, x = torch.meshgrid(*map(torch.arange, risen.shape[1:]), indexing="ij")
    near = torch.hypot(x - known[:, 0, None, None], y - known[:, 1, None, None]) < GATE_PX
    risen = risen * near
    found = _centroids((risen - risen.amax((1, 2), keepdim=True) / 3).clamp(min=0))
    along = known[-1] - known[0]
    normal = torch.stack([-along[1], along[0]]) / along.norm()
    error = found @ normal - known @ normal
    return float((error - error.mean()).square().mean().sqrt())


def _centroids(weight: Film) -> Float[Tensor, "frames 2"]:
    """Return the centres (x, y); NaN of a frame of zeros."""
    rows, columns = (torch.arange(side).to(weight) for side in weight.shape[1:])
    sums = torch.stack([weight.sum(1) @ columns, weight.sum(2) @ rows], 1)
    return sums / weight.sum((1, 2))[:, None]
