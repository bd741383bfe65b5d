"""The contrast threshold of a real camera, by the rate of its events (Stoffregen et al. 2020).

The simulator's rate over a grid of thresholds is inverted at the recording's rate.  This supposes
that simulated and real scene agree in texture, speed and turbulence: a rate that is wrong by 10 %
moves C by 4 to 10 %, and code values taken for light move it nearly threefold.  Noise counts too:
that of the simulated sensor must be the camera's.  Rates are events per pixel of the sensor, not of
the warped view, per second, ON and OFF apart.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import median_filter
from torch import Tensor

from src.recordings.simulated_recording import Progress, no_progress
from src.records.atomic import write_text
from src.records.results import format_csv
from src.sim.sensor.sensor import EventSensor, Sensor

HOT_FACTOR = 5.0  # times its neighbours' median plus its view's mean: more than texture makes
HOT_EVENTS = 10  # beyond that, so that a pixel is not hot by chance
ROUNDS = 10  # of simulating with the ratio of OFF to ON threshold found so far, at most
OFF_RATIOS = (0.1, 10.0)  # OFF to ON threshold
# Of the log quotient of ON to OFF rate that is left, over the log ratio of OFF to ON threshold.
FIRST_GAIN, GAINS = -2.5, (-6.0, -0.8)
FIRST_STEP = 0.05  # of the log ratio, at least
ENOUGH, MOST_EXCESS = 0.003, 0.03  # of the log quotient: a round is the last, a fit is refused
Clip = Float[Tensor, "views frames h w"]
GRID = tuple(np.geomspace(0.05, 2.0, 24).round(4).tolist())


@dataclass(frozen=True)
class EventRates:
    """`events` (slices, views, 2) ON and OFF in slices of `slice_s`; `pixels` of each view that
    count, `hot_pixels` left out."""

    events: Int[np.ndarray, "slices views 2"]
    pixels: Int[np.ndarray, " views"]
    hot_pixels: Int[np.ndarray, " views"]
    slice_s: float

    @property
    def per_view(self) -> Float[np.ndarray, "views 2"]:
        """In events / pixel / s, ON and OFF."""
        return self.events.sum(0) / (self.pixels[:, None] * len(self.events) * self.slice_s)

    @property
    def pooled(self) -> Float[np.ndarray, " 2"]:
        return self.events.sum((0, 1)) / (self.pixels.sum() * len(self.events) * self.slice_s)

    def bootstrap_pooled_rates(self, draws: int = 1000) -> Float[np.ndarray, "draws 2"]:
        """Return pooled rates of recordings put together from this one's blocks of n ** (1/3)
        successive slices, wrapping around (circular block bootstrap, Politis and Romano 1992)."""
        n = len(self.events)
        length = max(1, round(n ** (1 / 3)))
        first = np.random.default_rng(0).integers(n, size=(draws, -(-n // length), 1))
        slices = ((first + np.arange(length)) % n).reshape(draws, -1)[:, :n]
        events = self.events.sum(1)[slices].sum(1)
        return events / (self.pixels.sum() * n * self.slice_s)


def measure_event_rates(
    recording: Iterable[np.ndarray], view: Int[np.ndarray, "h w"], *, slices: int = 100
) -> EventRates:
    """Return the rates of a recording; it is gone through twice.

    `recording` yields structured arrays t (us), x, y, p in order of time each time it is iterated;
    `view`: that of each sensor pixel, -1 for none; `slices` of the time from the first to the last
    event.  Raises ValueError without two instants or without views.
    """
    totals, times = np.zeros(view.shape, np.int64), []
    for piece in recording:
        x, y = piece["x"].max(), piece["y"].max()
        height, width = view.shape
        if x >= width or y >= height:
            sensor = f"the {width}x{height} sensor of the views"
            raise ValueError(f"events lie outside {sensor}: up to {x}, {y}")
        times += [int(piece["t"][0]), int(piece["t"][-1])]
        pixels = np.ravel_multi_index((piece["y"], piece["x"]), view.shape)
        totals += np.bincount(pixels, minlength=totals.size).reshape(view.shape)
    if not times or times[-1] <= times[0]:
        raise ValueError("event rates need a recording of more than one instant")
    if view.max() < 0:
        raise ValueError("event rates need at least one view on the sensor")
    hot = find_hot_pixels(totals, view)
    used = np.where(hot, -1, view)
    views, start, span = int(view.max()) + 1, times[0], times[-1] - times[0] + 1
    events = np.zeros((slices, views, 2), np.int64)
    for piece in recording:
        owner = used[piece["y"], piece["x"]].astype(np.int64)
        part = (piece["t"] - start) * slices // span
        place = ((part * views + owner) * 2 + (piece["p"] < 0))[owner >= 0]
        events += np.bincount(place, minlength=events.size).reshape(events.shape)
    pixels, lost = (np.bincount(view[mask & (view >= 0)], minlength=views) for mask in (~hot, hot))
    return EventRates(events, pixels, lost, span * 1e-6 / slices)


def find_hot_pixels(totals: Int[np.ndarray, "h w"], view: Int[np.ndarray, "h w"]) -> np.ndarray:
    """Return where a pixel fires over 5 times as often as its neighbours and its view together."""
    mean = np.zeros(totals.shape)
    for index in np.unique(view[view >= 0]):
        mean[view == index] = totals[view == index].mean()
    return (view >= 0) & (totals > HOT_FACTOR * (median_filter(totals, 3) + mean) + HOT_EVENTS)


def require_both_polarities(rates: EventRates) -> None:
    """Raise ValueError for a recording without ON or without OFF events outside hot pixels."""
    on, off = rates.events.sum((0, 1)).tolist()
    if not on or not off:
        raise ValueError(f"recording must have ON and OFF events, got {on} ON and {off} OFF")


@dataclass(frozen=True)
class RateCurve:
    """Simulated rates of each clip (clips, thresholds, 2), ON and OFF in events / pixel / s, over
    the ON threshold."""

    thresholds: Float[np.ndarray, " k"]
    clip_rates: Float[np.ndarray, "clips k 2"]
    off_ratio: float

    @property
    def rates(self) -> Float[np.ndarray, "k 2"]:
        return self.clip_rates.mean(0)

    def draw_scene_factors(self, on: float, draws: int) -> Float[np.ndarray, "draws 2"]:
        """Return ON and OFF rate of one scene over the mean of the clips, both drawn at random.

        A bootstrap at the ON threshold `on`: the recording is taken for one more scene like the
        clips.  1 where there is one clip.
        """
        count = len(self.clip_rates)
        at = [
            [np.interp(np.log(on), np.log(self.thresholds), one) for one in clip.T]
            for clip in self.clip_rates
        ]
        rates = np.maximum(at, 1e-12 * np.max(at) + 1e-300)
        picks = np.random.default_rng(1).integers(count, size=(draws, count + 1))
        spread = math.sqrt(count / max(count - 1, 1))  # a mean of few is nearer to each of them
        scene = np.exp(spread * np.log(rates[picks[:, 0]] / rates.mean(0)))
        return scene * rates.mean(0) / rates[picks[:, 1:]].mean(1)


@dataclass(frozen=True)
class ThresholdEstimate:
    """`on` and `off` thresholds: (value, low, high), the last two a 95 % bootstrap CI over time and
    scenes; the measured `rates` (ON, OFF) with their `interval` over time (low and high, ON and
    OFF); `noise`: those of the simulated sensor (ON, OFF) while the light rests."""

    on: tuple[float, float, float]
    off: tuple[float, float, float]
    curve: RateCurve
    rates: Float[np.ndarray, " 2"]
    interval: Float[np.ndarray, "2 2"]
    noise: Float[np.ndarray, " 2"]

    @property
    def noise_share(self) -> float:
        """The share of the recording's events that the sensor makes without change of light."""
        return float(self.noise.sum() / self.rates.sum())


def simulate_event_rates(
    clips: Iterable[Clip], fps: float, sensor: Sensor, thresholds: Sequence[float] = GRID, *,
    off_ratio: float = 1.0, warmup: int = 0,
) -> RateCurve:  # fmt: skip
    """Return the rates of a sensor that sees `clips`, at all thresholds with the same noise.

    Events of the first `warmup` frame intervals do not count: they take the references from where
    they are drawn to where a running camera has them.
    Its own `threshold` and `off_ratio` are not used, and none of its pixels is hot: those of a
    recording are left out.  Raises ValueError for another sensor.
    """
    if not isinstance(sensor, EventSensor):
        raise ValueError(f"sensor must be an EventSensor, got {type(sensor).__name__}")
    grid = torch.tensor(thresholds, dtype=torch.float32)
    cool = replace(sensor, off_ratio=off_ratio, hot_pixel_fraction=0.0)
    sensors = [replace(cool, threshold=c) for c in thresholds]
    rates = []
    for index, frames in enumerate(clips):
        views, count, h, w = frames.shape
        counts = [
            one.counts(frames[None], fps, [index], first_interval=warmup)[0] for one in sensors
        ]
        exposure = views * h * w * (count - 1 - warmup) / fps
        rates.append((torch.stack(counts).sum(1).double() / exposure).numpy())
    return RateCurve(grid.double().numpy(), np.stack(rates), off_ratio)


def estimate_contrast_threshold(
    rates: EventRates, clips: Sequence[Clip], fps: float, sensor: Sensor,
    thresholds: Sequence[float] = GRID,
    progress: Progress[Clip] = no_progress, *, warmup: int = 0,
) -> ThresholdEstimate:  # fmt: skip
    """Return the thresholds at which the sensor makes the recording's rates.

    The geometric mean of ON and OFF rate gives their size; the quotient gives the ratio of OFF to
    ON, as what rises has to fall.  Intervals end where the grid does.  `progress(clips, name)`
    yields the clips of each of the ROUNDS, as rich.progress.track does.  `warmup`: as in
    `simulate_event_rates`.  Raises ValueError for a rate that the grid does not make, and for a
    quotient of rates that no ratio in OFF_RATIOS makes.
    """
    require_both_polarities(rates)
    measured, drawn = rates.pooled, np.maximum(rates.bootstrap_pooled_rates(), 1e-12)
    simulate = partial(simulate_event_rates, fps=fps, sensor=sensor, warmup=warmup)
    best, other = _find_off_ratio(measured, clips, simulate, thresholds, progress)
    moved = other.log_ratio - best.log_ratio
    gain = float(np.clip((other.excess - best.excess) / moved, *GAINS))
    on_gain = np.log(other.on / best.on) / moved

    scenes = best.curve.draw_scene_factors(best.on, len(drawn))
    pairs = np.concatenate([measured[None], drawn * scenes])
    ons = find_on_threshold(best.curve, pairs, at_ends=True)
    steps = -_log_excess_quotient(best.curve, ons, pairs) / gain
    ons = ons * np.exp(on_gain * steps)
    ratios = best.curve.off_ratio * np.exp(steps)
    on, off = float(ons[0]), float(ons[0] * ratios[0])
    drawn_on = np.clip(ons[1:], thresholds[0], thresholds[-1])
    drawn_off = drawn_on * np.clip(ratios[1:], *OFF_RATIOS)
    on_off = (_bound(on, drawn_on, thresholds), _bound(off, drawn_off, thresholds))
    still = [clip[:, -1:].expand_as(clip) for clip in clips]
    noise = simulate(still, thresholds=[best.on], off_ratio=best.curve.off_ratio).rates[0]
    interval = np.percentile(drawn, (2.5, 97.5), axis=0)
    return ThresholdEstimate(*on_off, best.curve, measured, interval, noise)


def _bound(
    value: float, drawn: Float[np.ndarray, " draws"], thresholds: Sequence[float]
) -> tuple[float, float, float]:
    """Return `value` with the middle 95 % of what was drawn, which ends where the grid does, or at
    a value beyond it."""
    ends = min(thresholds[0], value), max(thresholds[-1], value)
    low, high = np.clip(np.nanpercentile(drawn, (2.5, 97.5)), *ends).tolist()
    return value, low, high


@dataclass(frozen=True)
class _Round:
    """The ON threshold for an OFF ratio, and the log of how much larger the recording's quotient
    of ON to OFF rate is than that of the simulated curve there."""

    curve: RateCurve
    on: float
    excess: float

    @property
    def log_ratio(self) -> float:
        return float(np.log(self.curve.off_ratio))


def _find_off_ratio(
    measured: np.ndarray, clips: Sequence[Clip], simulate: Callable[..., RateCurve],
    thresholds: Sequence[float], progress: Progress[Clip],
) -> tuple[_Round, _Round]:  # fmt: skip
    """Return the round whose OFF ratio makes the quotient of the rates, by the secant method, and
    the one nearest to it, for slopes.  Raises ValueError where no ratio makes the rates."""
    log_ratio, gain, rounds = 0.0, FIRST_GAIN, list[_Round]()
    for number in range(1, ROUNDS + 1):
        followed = progress(clips, f"event rates, round {number} of {ROUNDS} at most")
        ratio = float(np.clip(np.exp(log_ratio), *OFF_RATIOS))
        curve = simulate(followed, thresholds=thresholds, off_ratio=ratio)
        on = float(find_on_threshold(curve, measured))
        if not np.isfinite(on) and rounds:  # the step was too long
            log_ratio = (log_ratio + rounds[-1].log_ratio) / 2
            continue
        if not np.isfinite(on):
            low, high = np.sqrt(np.prod(curve.rates[[-1, 0]], axis=1))
            raise ValueError(
                f"the recording's rate {np.sqrt(np.prod(measured)):.3g} is outside what the grid of"
                f" thresholds {thresholds[0]} to {thresholds[-1]} makes, {low:.3g} to {high:.3g}"
            )
        rounds.append(_Round(curve, on, float(_log_excess_quotient(curve, on, measured))))
        new, *before = rounds[::-1]
        if before and abs(new.excess) < ENOUGH:
            break
        if before:
            change = (new.excess - before[0].excess) / (new.log_ratio - before[0].log_ratio)
            gain = float(np.clip(change, *GAINS))
        step = -new.excess / gain
        least = 0.0 if before else FIRST_STEP  # so that there is a slope
        step = float(np.copysign(max(abs(step), least), step))
        log_ratio = float(np.clip(new.log_ratio + step, *np.log(OFF_RATIOS)))
        if log_ratio == new.log_ratio:
            break
    best, *others = sorted(rounds, key=lambda one: abs(one.excess))
    if abs(best.excess) > MOST_EXCESS:
        quotient, (low, high) = measured[0] / measured[1], OFF_RATIOS
        raise ValueError(
            f"the recording's quotient of ON to OFF rate, {quotient:.3g}, is not made by any ratio"
            f" of OFF to ON threshold in {low:g}..{high:g}: are scene, speed and sensor alike?"
        )
    return best, min(others, key=lambda one: abs(one.log_ratio - best.log_ratio))


def find_on_threshold(
    curve: RateCurve, rates: Float[np.ndarray, "*draws 2"], *, at_ends: bool = False
) -> Float[np.ndarray, "*draws"]:
    """Return the ON threshold with the geometric mean of `rates`.

    Beyond the grid it is nan, with `at_ends` the end of the grid.  Linear in log rate over log
    threshold, the simulated rates made monotone first.
    """
    mean = np.sqrt(np.maximum(np.prod(curve.rates, axis=1), 1e-30))
    falling = np.minimum.accumulate(np.log(mean))
    target = 0.5 * np.log(np.prod(rates, axis=-1))
    thresholds = np.log(curve.thresholds)[::-1]
    ends = (None, None) if at_ends else (np.nan, np.nan)
    return np.asarray(np.exp(np.interp(target, falling[::-1], thresholds, *ends)))


def _log_excess_quotient(curve: RateCurve, on: np.ndarray | float, rates: np.ndarray) -> np.ndarray:
    """Return the log of how much larger the quotient of ON to OFF rate is than the curve's."""
    quotient = np.subtract(*np.log(np.maximum(curve.rates, 1e-15)).T)
    expected = np.interp(np.log(on), np.log(curve.thresholds), quotient)
    return np.asarray(np.log(rates[..., 0] / rates[..., 1]) - expected)


def write_threshold_csv(estimate: ThresholdEstimate, rates: EventRates, path: Path) -> None:
    """Write the curve, the rates of each view and the estimate as one table."""
    curve = zip(estimate.curve.thresholds, estimate.curve.rates, strict=True)
    rows = [("simulated_hz", f"{threshold:.4g}", *pair) for threshold, pair in curve]
    rows += [("noise_hz", "", *estimate.noise)]
    rows += [("measured_hz", index, *pair) for index, pair in enumerate(rates.per_view)]
    bounds = zip(("estimate", "low", "high"), estimate.on, estimate.off, strict=True)
    rows += [(name, "", on, off) for name, on, off in bounds]
    texts = [(what, which, *(f"{value:.5g}" for value in pair)) for what, which, *pair in rows]
    write_text(path, format_csv(("what", "threshold_or_view", "on", "off"), texts))
