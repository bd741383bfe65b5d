"""Stress test of fast motion: whether a target on a straight trajectory is reconstructed on it."""

import math
from collections.abc import Sequence
from statistics import fmean
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import ClipConditions, EventClip, Film, StressBench
from src.bench.stress_tests.stress_results import StressResult

LAG_FRAMES = 6  # over which brightening is measured
GATE_PX = 24.0  # around the true front
MARGIN_PX = 12.0  # from the frame's border, within which the true front does not count
WARMUP_FRAMES = 32  # until the target has left its first place, which no event tells
MIN_CORRELATION = 0.2  # with the true brightening within the gate; of white noise it is below 0.1
MOST_LOST = 0.5  # of the frames, beyond which a network does not show the target


def measure_trajectory_deviation(
    network: Candidate, bench: StressBench, *, limit_px: float, window_length: str = "frame"
) -> StressResult:
    """Return the rms distance, in pixels, of the front of a flying target from its line, across it;
    the mean over clips of one target.  NaN where the target is lost in over MOST_LOST of the
    frames.  `window_length`, `frame` or `trained`: of a network that does not use its windows'
    length; those of others grow.

    The front is the centroid of what has become brighter in the last frames near where it truly is.
    Unjudged beside it are the network's mean without turbulence, that of the light of one view,
    that of the network and every clip, each named with the share of frames in which the target is
    lost.
    """

    def measure(clip: EventClip) -> CrossTrackError:
        numbers = range(1, len(clip.target))
        frames = clip.reconstruct_at_rate(network, clip.fps, numbers, window_length)
        return measure_cross_track_error(frames[:, 0], clip.target[1:])

    clips = bench.clips()
    without = list(map(measure, bench.clips(ClipConditions(d_over_r0=0.0))))
    light = [measure_cross_track_error(c.turbulent[1:], c.target[1:]) for c in clips]
    errors = list(map(measure, clips))
    rows = {"no turbulence": without, "light of one view": light, "mean": errors}
    rows |= {f"clip {n}": [error] for n, error in zip(bench.indices, errors, strict=True)}
    means = {name: _mean_error(row) for name, row in rows.items()}
    shown = [(f"{name} ({100 * e.lost_share:.0f} % lost)", e.px) for name, e in means.items()]
    mean = means["mean"]
    value = mean.px if mean.lost_share <= MOST_LOST else math.nan
    return StressResult(value, "px", limit_px, varied="video", unjudged=shown)


class CrossTrackError(NamedTuple):
    """`px`: rms over the frames that show the target, NaN of fewer than four; `lost_share` of the
    frames do not."""

    px: float
    lost_share: float


def _mean_error(errors: Sequence[CrossTrackError]) -> CrossTrackError:
    found = [error.px for error in errors if not math.isnan(error.px)]
    lost = fmean(error.lost_share for error in errors)
    return CrossTrackError(fmean(found) if found else math.nan, lost)


def measure_cross_track_error(frames: Film, truth: Film) -> CrossTrackError:
    """Return the distance, in pixels, of the front in `frames` from its line in `truth`.

    A frame shows the target where its brightening near the true front correlates with the true one
    by MIN_CORRELATION.  Raises ValueError for fewer than four frames that count.
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
    known, risen, true = known[counts], risen[counts], true[counts]
    y, x = torch.meshgrid(*map(torch.arange, risen.shape[1:]), indexing="ij")
    near = torch.hypot(x - known[:, 0, None, None], y - known[:, 1, None, None]) < GATE_PX
    shown = _correlate(risen, true, near) > MIN_CORRELATION
    lost = 1 - float(shown.float().mean())
    if shown.sum() < 4:
        return CrossTrackError(math.nan, lost)
    known, risen = known[shown], (risen * near)[shown]
    found = _centroids((risen - risen.amax((1, 2), keepdim=True) / 3).clamp(min=0))
    along = known[-1] - known[0]
    normal = torch.stack([-along[1], along[0]]) / along.norm()
    error = found @ normal - known @ normal
    return CrossTrackError(float((error - error.mean()).square().mean().sqrt()), lost)


def _correlate(a: Film, b: Film, mask: Bool[Tensor, "frames h w"]) -> Float[Tensor, " frames"]:
    """Return the correlation of each frame of `a` and `b` within `mask`; 0 of a constant one."""
    count = mask.sum((1, 2), keepdim=True)
    a, b = (
        torch.where(mask, film - (film * mask).sum((1, 2), keepdim=True) / count, 0.0)
        for film in (a, b)
    )
    power = (a.square().sum((1, 2)) * b.square().sum((1, 2))).clamp(min=1e-12)
    return (a * b).sum((1, 2)) / power.sqrt()


def _centroids(weight: Film) -> Float[Tensor, "frames 2"]:
    """Return the centres (x, y); NaN of a frame of zeros."""
    rows, columns = (torch.arange(side).to(weight) for side in weight.shape[1:])
    sums = torch.stack([weight.sum(1) @ columns, weight.sum(2) @ rows], 1)
    return sums / weight.sum((1, 2))[:, None]
