"""Turbulence in front of a still scene: what a video shows of tilt and blur, with intervals.

Lengths are in pixels of a frame whose smaller side is 256.  Intervals of 95 % come from resampling
blocks of frames and squares of the frame (bootstrap) and, for some, from METHOD_ERROR.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from src.recordings.files.turbulence_file import ALLOWED, SIDE, IntervalEstimate, TurbulenceFile
from src.recordings.turbulence_measurement import tilt_covariance
from src.recordings.turbulence_measurement.camera_drift import remove_camera_drift
from src.recordings.turbulence_measurement.point_tracking import (
    PointTracks,
    find_corners,
    track_points,
)
from src.recordings.turbulence_measurement.tilt_covariance import (
    CELLS,
    CovarianceModel,
    TiltStatistics,
)

SIZES = (512, 362, SIDE)  # pixels of the shorter side that is worked on: larger frames are shrunk
MIN_TRACKED = 0.75  # of the corners, or the next smaller size is tried
MIN_FRAMES, MIN_POINTS = 16, 40
MIN_FOUND = 0.6  # of the frames, or a point is left out
MIN_SHARE = 0.2  # of the corners must be tracked: where the camera moves, fewer are
MAX_RELATIVE_POWER = 9.0  # times the median power: such a point moves by itself
MAX_DRIFT_PX = 4.0  # between the quarters of a video: more is a camera that moves
MIN_RMS_PX = 0.01  # less is the error of tracking
MIN_OVER_NOISE = 0.15  # of the power of tilt over that of noise: up to 0.09 is found without tilt
MIN_HALF_LENGTH_PX = 4.0  # of the frame that is worked on: what JPEG adds is correlated over less
FLICKER_SHARE = 1 / 32  # of the side, deviation of a Gaussian: bands of lamps are wider
DRAWS = 200
SHARPEST = 0.1  # the sharpest tenth
SHARPEST_LACKS = 0.65  # of the blur, typically: scripts/check_turbulence_meter.py
BLUR_OF_WARPS_PX = 0.3  # that tilt alone, stretching what a window shows, is taken for
FILM_OVER_DECAY = 8.0  # a decay that is more than the film over this is known by its lower bound
# Share of the power left after taking off a film's mean, of correlation exp(-time / the film).
LEFT_OF_SLOW = 1 - 2 / math.e
# Errors of the method at 95 %, of the logarithm, added to the intervals, from clips of known
# turbulence (scripts/check_turbulence_meter.py): windows average, random blur shifts corners.
METHOD_ERROR = {"tilt_rms_px": 0.15, "tilt_correlation_half_length_px": 0.3, "blur_px": 0.5}


@dataclass(frozen=True)
class TurbulenceMeasurement:
    """What was `found`, and the curves behind it, lengths in pixels of a frame of SIDE.

    `tilt` holds curves over `distance_px`, over `fitted_distance_px` and over lags in frames;
    `rms_px` of every point at `place` (x, y), in pixels of `picture`; `corners`: how many were
    tried; `camera_drift_px`: the longest way over the film that was taken off as the camera's.
    """

    found: TurbulenceFile
    tilt: TiltStatistics
    distance_px: Float[np.ndarray, " distances"]
    fitted_distance_px: Float[np.ndarray, " k"]
    picture: Float[np.ndarray, "h w"]
    place: Float[np.ndarray, "points 2"]
    rms_px: Float[np.ndarray, " points"]
    frames: int
    corners: int
    fps: float | None
    camera_drift_px: float

    def summary(self) -> dict[str, str]:
        """Return each number of `found` with its interval, for a person; a drift, if there is."""
        numbers = {name: str(value) for name, value in vars(self.found).items()}
        if self.camera_drift_px:
            numbers["camera_drift_px"] = f"{self.camera_drift_px:.2g}, removed"
        return numbers


def measure_turbulence(
    frames: Float[np.ndarray, "frames h w"], fps: float | None = None
) -> TurbulenceMeasurement:
    """Measure the turbulence in a video of a still scene, grey in [0, 1]; `fps` None: not known.

    Raises ValueError for a video that is too short, has no texture, moves, or shows no tilt that
    can be told from the error of tracking.
    """
    if len(frames) < MIN_FRAMES:
        raise ValueError(f"video must have at least {MIN_FRAMES} frames, got {len(frames)}")
    frames, tracks = _track_corners(remove_flicker(frames))
    size, corners = frames.shape[1:], len(tracks.place)
    tracks, drift = _select_still(tracks, size)
    unit = SIDE / min(size)
    pairs = tilt_covariance.sum_over_distance(tracks, size)
    lags = tilt_covariance.sum_autocovariance(tracks, size)
    model = CovarianceModel(pairs.at, tracks.window_variance_px2, size)

    def describe(*weights: np.ndarray) -> TiltStatistics:
        over_lags, _ = lags.weighted_mean_and_count(*weights)
        return model.describe_tilt(*pairs.weighted_mean_and_count(*weights), over_lags, len(frames))

    tilt = describe(np.ones(len(frames)), np.ones(CELLS**2))
    rms_px = tilt.power_px2**0.5 * unit
    if rms_px < MIN_RMS_PX:
        raise _no_tilt(rms_px, len(tracks.place), "which is none")
    if tilt.half_length_px < MIN_HALF_LENGTH_PX:
        reach = f"correlated over {tilt.half_length_px * unit:.1f} px: errors of compression, too,"
        reach += f" are over less than {MIN_HALF_LENGTH_PX * unit:.1f} px of such frames"
        raise _no_tilt(rms_px, len(tracks.place), reach)
    drawn = [describe(*chosen) for chosen in _resampled(len(frames), 2 * tilt.decay_frames)]
    numbers = _summarize_tilt(tilt, drawn, unit, fps, len(frames))
    numbers["blur_px"] = estimate_blur(*_track_at_side(frames, tracks))
    return TurbulenceMeasurement(
        found=TurbulenceFile(**numbers),
        tilt=tilt,
        distance_px=pairs.at * unit,
        fitted_distance_px=model.fitted_distance_px * unit,
        picture=frames.mean(0),
        place=tracks.place,
        rms_px=np.sqrt(np.maximum(tilt_covariance.tilt_variance_per_axis(tracks), 0)) * unit,
        frames=len(frames),
        corners=corners,
        fps=fps,
        camera_drift_px=drift * unit,
    )


def estimate_blur(tracks: PointTracks, size: tuple[int, int]) -> IntervalEstimate:
    """Return the blur of a typical moment beyond diffraction, the standard deviation of a Gaussian,
    in pixels of SIDE, from what blurs a typical moment beyond the sharpest tenth of moments.

    A moment's sharpness is the slope of its gradient over that of the registered mean.  Of an edge
    that is blurred by a Gaussian of width s, and of width S in that mean, it is
    sqrt(2 S^2 / (s^2 + S^2)); S^2 is the gradient's power over twice the `curvature`, whence s^2.
    The tenth is chosen by one estimate and measured by the other, so that noise does not choose.
    It is not free of blur (lucky images: Fried 1978, JOSA 68, 1651): between it and a typical
    moment is SHARPEST_LACKS of the blur.
    """
    rows = []
    for chosen_by, value in (tracks.sharp, tracks.sharp[::-1]):
        ranked = np.sort(np.where(tracks.seen, chosen_by, -np.inf), axis=0)[::-1]
        most = np.maximum(np.round(SHARPEST * tracks.seen.sum(0)).astype(int), 1)
        sharpest = tracks.seen & (chosen_by >= ranked[most - 1, np.arange(len(most))])
        rows.append([(value * of).sum(0) / of.sum(0) for of in (tracks.seen, sharpest)])
    slopes = np.mean(rows, axis=0) * tracks.texture
    where = tilt_covariance.frame_squares(tracks, size)
    terms = (*slopes, tracks.texture, tracks.curvature)
    sums = np.stack([np.bincount(where, row, CELLS**2) for row in terms])
    unit = SIDE / min(size) / SHARPEST_LACKS
    drawn = [_sharpest_lack_px(sums @ squares) * unit for _, squares in _resampled(1, 1.0)]
    blur = _estimate("blur_px", _sharpest_lack_px(sums @ np.ones(CELLS**2)) * unit, drawn)
    assert blur.low is not None, "_estimate gives one"
    least = math.sqrt(max(blur.low**2 - BLUR_OF_WARPS_PX**2, ALLOWED["blur_px"][0] ** 2))
    return blur._replace(low=least)


def _sharpest_lack_px(sums: Float[np.ndarray, "4"]) -> float:
    """Return what blurs all moments beyond the sharpest, of sums of slopes (all, the sharpest), of
    texture and of curvature."""
    usual, sharpest, texture, curvature = sums
    edge_px2 = texture / (2 * max(-curvature, 1e-12))
    apart_px2 = 2 * edge_px2 * texture**2 * (1 / usual**2 - 1 / sharpest**2)
    return math.sqrt(max(apart_px2, 1e-6))


def remove_flicker(frames: Float[np.ndarray, "frames h w"]) -> Float[np.ndarray, "frames h w"]:
    """Return the frames with the mean brightness of every row, averaged over rows: what lamps
    change, also in the bands of a rolling shutter, is not turbulence."""
    spread = FLICKER_SHARE * min(frames.shape[1:])
    level = gaussian_filter1d(frames.mean(2), spread, axis=1, mode="nearest")
    gain = level.mean(0) / np.maximum(level, 1e-3)
    return (frames * gain[..., None]).astype(np.float32)


def limit_shorter_side(frame: np.ndarray, max_px: int = SIZES[0]) -> Float[np.ndarray, "_h _w"]:
    """Return a frame whose shorter side has `max_px` at most: so large it is worked on."""
    least = min(frame.shape)
    if least <= max_px:
        return frame
    height, width = (round(side * max_px / least) for side in frame.shape)
    return cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)


def _track_at_side(frames: np.ndarray, tracks: PointTracks) -> tuple[PointTracks, tuple[int, int]]:
    """Return the points tracked in frames of SIDE pixels, which blur ratios are stated for, and
    the size of these."""
    size = frames.shape[1:]
    if min(size) <= SIDE:
        return tracks, size
    small = np.stack([limit_shorter_side(frame, SIDE) for frame in frames])
    place = np.round(tracks.place * SIDE / min(size)).astype(np.float32)
    again = track_points(small, place)
    return again.select(again.seen.mean(0) >= MIN_FOUND), small.shape[1:]


def _track_corners(frames: np.ndarray) -> tuple[np.ndarray, PointTracks]:
    """Return the frames at the largest of SIZES at which most corners are tracked, and these: tilt
    may move fine frames by more pixels than a corner can be tracked over."""
    least, found = min(frames.shape[1:]), None
    for side in (min(least, SIZES[0]), *(side for side in SIZES[1:] if side < least)):
        small = np.stack([limit_shorter_side(frame, side) for frame in frames])
        place = find_corners(small.mean(0))
        if len(place) < MIN_POINTS:
            break
        found = small, track_points(small, place)
        if (found[1].seen.mean(0) >= MIN_FOUND).mean() >= MIN_TRACKED:
            break
    if found is None:
        raise ValueError(f"video must show texture, {MIN_POINTS} corners or more, got {len(place)}")
    return found


def _select_still(tracks: PointTracks, size: tuple[int, int]) -> tuple[PointTracks, float]:
    """Return the points that only turbulence moves, and the drift of the camera that was taken off,
    in pixels over the film; raises ValueError where few do."""
    tracked = tracks.seen.mean(0) >= MIN_FOUND
    share = f"{tracked.mean():.0%} of {len(tracked)} corners could be tracked"
    if tracked.mean() < MIN_SHARE or tracked.sum() < MIN_POINTS:
        raise ValueError(
            f"video must show a scene that stands still: {share}, at least {MIN_SHARE:.0%} and"
            f" {MIN_POINTS} are wanted"
        )
    tracks = tracks.select(tracked)
    # How far apart the whole scene lies in the most different quarters of the video.
    moved = np.where(tracks.seen[..., None], tracks.moved.mean(0), np.nan)
    quarters = [np.nanmedian(part, axis=(0, 1)) for part in np.array_split(moved, 4)]
    apart = max(np.hypot(*(one - other)) for one in quarters for other in quarters)
    drift = float(apart) * SIDE / min(size)
    if drift > MAX_DRIFT_PX:
        raise ValueError(
            f"video must show a scene that stands still, got one that moves by {drift:.0f} px of"
            f" {SIDE}; {share}"
        )
    tracks, way = remove_camera_drift(tracks)
    return _select_alike(tracks, SIDE / min(size)), way


def _select_alike(tracks: PointTracks, unit: float) -> PointTracks:
    """Return the points that move about as much as most do; raises ValueError where noise hides
    that or fewer than MIN_POINTS are left.  `unit`: pixels of SIDE in a pixel of the frames."""
    power = tilt_covariance.tilt_variance_per_axis(tracks)
    typical = float(np.median(power))
    if typical <= 0:  # half of the points show noise alone
        raise _no_tilt(0.0, len(power), "which is none")
    alike = power < MAX_RELATIVE_POWER * typical
    if alike.sum() < MIN_POINTS:
        wanted = f"at least {MIN_POINTS} points are wanted"
        raise _no_tilt(math.sqrt(typical) * unit, int(alike.sum()), wanted)
    tracks = tracks.select(alike)
    first, second = tilt_covariance.centre_displacements(tracks)
    tilt, noise = float((first * second).mean()), float(((first - second) ** 2).mean() / 2)
    if tilt < MIN_OVER_NOISE * noise:
        rms_px = math.sqrt(max(tilt, 0.0)) * unit
        raise _no_tilt(rms_px, len(tracks.place), "which is none beside the noise")
    return tracks


def _no_tilt(rms_px: float, points: int, reason: str) -> ValueError:
    """Return the error of footage without tilt that can be measured; `rms_px` of SIDE."""
    return ValueError(
        f"video must show a scene through turbulent air, got a tilt of {rms_px:.3f} px rms"
        f" of {SIDE} at {points} points, {reason}"
    )


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


def _summarize_tilt(
    tilt: TiltStatistics, drawn: list[TiltStatistics], unit: float, fps: float | None, frames: int
) -> dict[str, IntervalEstimate]:
    """Return the numbers of the tilt in so many `frames`; where a time or a length is beyond reach,
    what bounds it.

    Of turbulence as slow as the film a part is lost with the mean, which the film does not tell:
    its rms is bounded by that of a decay as long as the film.
    """
    lengths = [one.half_length_px * unit for one in drawn]
    length = tilt.half_length_px * unit
    half = _estimate("tilt_correlation_half_length_px", length, lengths, most=float(SIDE))
    spreads = [one.power_px2**0.5 * unit for one in drawn]
    rms = _estimate("tilt_rms_px", tilt.power_px2**0.5 * unit, spreads)
    longest = longest_decay_frames(frames)
    if tilt.decay_frames > longest:
        assert rms.high is not None, "an rms is bounded"
        slow = [(one.power_px2 * one.left_share / LEFT_OF_SLOW) ** 0.5 * unit for one in drawn]
        rms = rms._replace(high=max(rms.high, float(np.percentile(slow, 97.5))))
    shares = [one.whole_view_share for one in drawn]
    if fps is None:
        decay = IntervalEstimate(None, None, None)
    elif tilt.decay_frames < 1:  # within the first frame it has no value but a bound
        decay = IntervalEstimate(None, None, 1 / fps)
    else:
        times = [max(one.decay_frames, 0.5) / fps for one in drawn]
        time_s = tilt.decay_frames / fps
        decay = _estimate("tilt_correlation_time_s", time_s, times, most=longest / fps)
    return {
        "tilt_rms_px": rms,
        "tilt_correlation_half_length_px": half,
        "global_tilt_share": _estimate("global_tilt_share", tilt.whole_view_share, shares),
        "tilt_correlation_time_s": decay,
    }


def longest_decay_frames(frames: int) -> float:
    """Return the longest decay that a film of so many frames can give a value for."""
    return min(frames / FILM_OVER_DECAY, tilt_covariance.MAX_LAG - 1)


def _estimate(
    name: str, value: float, drawn: list[float], most: float = np.inf
) -> IntervalEstimate:
    """Return a value with the middle 95 % of what was drawn; beyond `most` only that is known."""
    low, high = np.percentile(np.nan_to_num(drawn, posinf=1e9), (2.5, 97.5))
    low, high = min(low, value, most), max(high, value)
    if value <= most and name in METHOD_ERROR:
        low = value * math.exp(-math.hypot(math.log(value / max(low, 1e-9)), METHOD_ERROR[name]))
        high = value * math.exp(math.hypot(math.log(high / value), METHOD_ERROR[name]))
    low, middle, top = (float(number) for number in np.clip((low, value, high), *ALLOWED[name]))
    return IntervalEstimate(middle if value <= most else None, low, top if high <= most else None)
