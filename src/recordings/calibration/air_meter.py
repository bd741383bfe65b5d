"""The air in front of a still scene: what its footage shows of tilt and blur, with intervals.

Lengths are in pixels of a frame whose smaller side is 256.  Intervals of 95 % come from resampling
blocks of frames and squares of the frame (bootstrap), which knows of chance only, and, for the
numbers in METHOD, from what the method itself errs by.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from src.recordings.calibration import covariance, following
from src.recordings.calibration.covariance import CELLS, Model, Tilt
from src.recordings.calibration.following import Tracks
from src.recordings.files.measured import ALLOWED, SIDE, AirFile, Estimate

SIZES = (512, 362, SIDE)  # pixels of the shorter side that is worked on: larger frames are shrunk
FOLLOWED = 0.75  # of the corners, or the next smaller size is tried
LEAST_FRAMES, LEAST_POINTS = 16, 40
LEAST_SEEN = 0.6  # of the frames, or a point is left out
LEAST_SHARE = 0.2  # of the corners must be followed: where the camera moves, fewer are
RESTLESS = 9.0  # times the median power: such a point is on a car, not behind air
DRIFT_PX = 4.0  # between the quarters of a film: more is a camera that moves
LEAST_RMS_PX = 0.01  # less is the error of following
DRAWS = 200
LUCKY = 0.1  # the sharpest tenth
# Errors of the method at 95 %, of the logarithm, added to the intervals: in clips of known air
# (scripts/known_air.py) windows average, and random blur shifts corners as tilt does.
METHOD = {"rms_px": 0.15, "half_length_px": 0.3}


@dataclass(frozen=True)
class Air:
    """What was `found`, and the curves behind it, lengths in pixels of a frame of SIDE.

    `tilt` holds curves over `distance_px`, over `fitted_px` and over lags in frames; `rms_px` of
    every point at `place` (x, y), in pixels of `picture`; `corners`, how many it was tried with;
    `fps` None: not known.
    """

    found: AirFile
    tilt: Tilt
    distance_px: Float[np.ndarray, " distances"]
    fitted_px: Float[np.ndarray, " k"]
    picture: Float[np.ndarray, "h w"]
    place: Float[np.ndarray, "points 2"]
    rms_px: Float[np.ndarray, " points"]
    frames: int
    corners: int
    fps: float | None


def measure(frames: Float[np.ndarray, "frames h w"], fps: float | None = None) -> Air:
    """Measure the air in a film of a still scene, grey in [0, 1]; `fps` None: not known.

    Raises ValueError for a film that is too short, has no texture or moves.
    """
    if len(frames) < LEAST_FRAMES:
        raise ValueError(f"video must have at least {LEAST_FRAMES} frames, got {len(frames)}")
    level = frames.mean((1, 2), keepdims=True)
    # To one mean brightness: flicker is not air.
    frames = (frames * (level.mean() / np.maximum(level, 1e-6))).astype(np.float32)
    frames, tracks = _followed(frames)
    size, corners = frames.shape[1:], len(tracks.place)
    tracks = _usable(tracks, size)
    unit = SIDE / min(size)
    pairs, lags = covariance.over_distance(tracks, size), covariance.over_time(tracks, size)
    model = Model(pairs.at, tracks.window_px2, size)
    tilt = model.tilt(*pairs.mean(), lags.mean()[0], len(frames))
    rms_px = tilt.power**0.5 * unit
    if rms_px < LEAST_RMS_PX:
        raise ValueError(
            f"video must show a scene through air, got a tilt of {rms_px:.3f} px rms of {SIDE} at"
            f" {len(tracks.place)} points, which is none"
        )
    drawn = [
        model.tilt(*pairs.mean(*chosen), lags.mean(*chosen)[0], len(frames))
        for chosen in _resampled(len(frames), 2 * tilt.decay)
    ]
    numbers = _air_file(tilt, drawn, unit, fps, len(lags.at))
    numbers["blur_ratio"] = blur_ratio(*_coarse(frames, tracks))
    a, b = covariance.centred(tracks)
    power = (a * b).sum((0, 2)) / (2 * tracks.seen.sum(0))
    return Air(
        found=AirFile(**numbers),
        tilt=tilt,
        distance_px=pairs.at * unit,
        fitted_px=model.fitted_px * unit,
        picture=frames.mean(0),
        place=tracks.place,
        rms_px=np.sqrt(np.maximum(power, 0)) * unit,
        frames=len(frames),
        corners=corners,
        fps=fps,
    )


def blur_ratio(tracks: Tracks, size: tuple[int, int]) -> Estimate:
    """Return how much wider an edge is at a typical moment than in its sharpest tenth of moments.

    A moment's sharpness is the slope of its gradient over that of the registered mean.  Between
    edges blurred by Gaussians of widths s and S that is sqrt(2 S^2 / (s^2 + S^2)), whence s / S.
    The tenth is chosen by one estimate and measured by the other, so that noise does not choose.
    Up to a D/r0 of about 5 it is nearly free of turbulence (Fried 1978, JOSA 68, 1651).
    """
    rows = []
    for chosen_by, value in (tracks.sharp, tracks.sharp[::-1]):
        ranked = np.sort(np.where(tracks.seen, chosen_by, -np.inf), axis=0)[::-1]
        most = np.maximum(np.round(LUCKY * tracks.seen.sum(0)).astype(int), 1)
        lucky = tracks.seen & (chosen_by >= ranked[most - 1, np.arange(len(most))])
        rows.append([(value * of).sum(0) / of.sum(0) for of in (tracks.seen, lucky)])
    slopes = np.mean(rows, axis=0) * tracks.texture
    where = covariance.squares(tracks, size)
    sums = np.stack([np.bincount(where, row, CELLS**2) for row in (*slopes, tracks.texture)])
    drawn = [_wider(sums @ squares) for _, squares in _resampled(1, 1.0)]
    return _estimate("blur_ratio", _wider(sums @ np.ones(CELLS**2)), drawn)


def _wider(sums: Float[np.ndarray, "3"]) -> float:
    """Return the ratio of widths for sums of slopes (all moments, the sharpest) and weights."""
    usual, sharpest = (max(2 / (total / sums[2]) ** 2 - 1, 1e-3) for total in sums[:2])
    return max(math.sqrt(usual / sharpest), 1.0)


def shrunk(frame: Float[np.ndarray, "h w"], largest: int = SIZES[0]) -> Float[np.ndarray, "_h _w"]:
    """Return a frame whose smaller side has `largest` pixels at most: so large it is worked on."""
    least = min(frame.shape)
    if least <= largest:
        return frame
    height, width = (round(side * largest / least) for side in frame.shape)
    return cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)


def _coarse(frames: np.ndarray, tracks: Tracks) -> tuple[Tracks, tuple[int, int]]:
    """Return the points followed in frames of SIDE pixels, and their size.

    How much blur widens an edge depends on the pixels that it is seen with.
    """
    size = frames.shape[1:]
    if min(size) <= SIDE:
        return tracks, size
    small = np.stack([shrunk(frame, SIDE) for frame in frames])
    place = np.round(tracks.place * SIDE / min(size)).astype(np.float32)
    again = following.follow(small, place)
    return again.of(again.seen.mean(0) >= LEAST_SEEN), small.shape[1:]


def _followed(frames: np.ndarray) -> tuple[np.ndarray, Tracks]:
    """Return the frames at the largest of SIZES at which most corners are followed, and these.

    Strong tilt moves fine frames by more pixels than a corner can be followed over.
    """
    least, found = min(frames.shape[1:]), None
    for side in (min(least, SIZES[0]), *(side for side in SIZES[1:] if side < least)):
        small = frames if side == least else np.stack([shrunk(frame, side) for frame in frames])
        place = following.corners(small.mean(0))
        if len(place) < LEAST_POINTS:
            break
        found = small, following.follow(small, place)
        if (found[1].seen.mean(0) >= LEAST_SEEN).mean() >= FOLLOWED:
            break
    if found is None:
        raise ValueError(
            f"video must show texture, {LEAST_POINTS} corners or more, got {len(place)}, in"
            f" {_covered(place, small.shape[1:]):.0%} of the frame"
        )
    return found


def _usable(tracks: Tracks, size: tuple[int, int]) -> Tracks:
    """Return the points that stand still but for the air; raises ValueError where few do."""
    followed = tracks.seen.mean(0) >= LEAST_SEEN
    if followed.mean() < LEAST_SHARE or followed.sum() < LEAST_POINTS:
        part = _covered(tracks.place[followed], size)
        raise ValueError(
            f"video must show a scene that stands still: of {len(followed)} corners"
            f" {followed.mean():.0%} (in {part:.0%} of the frame) could be followed, at least"
            f" {LEAST_SHARE:.0%} and {LEAST_POINTS} are wanted"
        )
    tracks = tracks.of(followed)
    drift = _drift(tracks) * SIDE / min(size)
    if drift > DRIFT_PX:
        raise ValueError(
            f"video must show a scene that stands still, got one that moves by {drift:.0f} px of"
            f" {SIDE}; {followed.mean():.0%} of {len(followed)} corners could be followed"
        )
    a, b = covariance.centred(tracks)
    power = (a * b).sum((0, 2)) / tracks.seen.sum(0)
    return tracks.of(power < RESTLESS * np.median(power))


def _drift(tracks: Tracks) -> float:
    """Return how far apart the whole scene lies in the most different quarters of the film."""
    moved = np.where(tracks.seen[..., None], tracks.moved.mean(0), np.nan)
    quarters = [np.nanmedian(part, axis=(0, 1)) for part in np.array_split(moved, 4)]
    return float(max(np.hypot(*(one - other)) for one in quarters for other in quarters))


def _covered(place: np.ndarray, size: tuple[int, int]) -> float:
    """Return the share of 8 x 8 parts of the frame that hold a point."""
    parts = (place * 8 / size[::-1]).astype(int).clip(0, 7)
    return len(np.unique(parts @ [1, 8])) / 64


def _resampled(frames: int, block: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield how often each frame, in blocks, and each square of the frame is drawn; DRAWS times."""
    random, most = np.random.default_rng(0), frames // 4
    length = int(np.clip(np.ceil(block), 1, max(most, 1))) if np.isfinite(block) else most
    for _ in range(DRAWS):
        starts = random.integers(frames, size=math.ceil(frames / length))
        drawn = (starts[:, None] + np.arange(length)).ravel()[:frames] % frames
        squares = random.integers(CELLS**2, size=CELLS**2)
        times = np.bincount(drawn, minlength=frames), np.bincount(squares, minlength=CELLS**2)
        yield times[0].astype(float), times[1].astype(float)


def _air_file(
    tilt: Tilt, drawn: list[Tilt], unit: float, fps: float | None, lags: int
) -> dict[str, Estimate]:
    """Return the numbers of the tilt; where a time or a length is beyond reach, what bounds it."""
    lengths = [one.half_px * unit for one in drawn]
    half = _estimate("half_length_px", tilt.half_px * unit, lengths, most=float(SIDE))
    if half.value is not None and half.value < 1.3 * covariance.SHORTEST * unit:
        half = replace(half, low=ALLOWED["half_length_px"][0])  # shorter ones look alike
    spreads = [one.power**0.5 * unit for one in drawn]
    return {
        "rms_px": _estimate("rms_px", tilt.power**0.5 * unit, spreads),
        "half_length_px": half,
        "whole_share": _estimate("whole_share", tilt.whole, [one.whole for one in drawn]),
        "decay_s": _decay(tilt.decay, [one.decay for one in drawn], fps, lags),
    }


def _decay(frames: float, drawn: list[float], fps: float | None, lags: int) -> Estimate:
    """Return the time to 1/e.  Within the first frame it has no value but a bound."""
    if fps is None:
        return Estimate(None, None, None)
    if frames < 1:
        return Estimate(None, None, 1 / fps)
    times = [max(one, 0.5) / fps for one in drawn]
    return _estimate("decay_s", frames / fps, times, most=(lags - 1) / fps)


def _estimate(name: str, value: float, drawn: list[float], most: float = np.inf) -> Estimate:
    """Return a value with the middle 95 % of what was drawn; beyond `most` only that is known."""
    low, high = np.percentile(np.nan_to_num(drawn, posinf=1e9), (2.5, 97.5))
    low, high = min(low, value, most), max(high, value)
    if value <= most and name in METHOD:
        low = value * math.exp(-math.hypot(math.log(value / max(low, 1e-9)), METHOD[name]))
        high = value * math.exp(math.hypot(math.log(high / value), METHOD[name]))
    low, middle, top = (float(number) for number in np.clip((low, value, high), *ALLOWED[name]))
    return Estimate(middle if value <= most else None, low, top if high <= most else None)
