"""The contrast threshold of a real camera, by the rate of its events (Stoffregen et al. 2020).

The simulator's rate over a grid of thresholds is inverted at the recording's rate.  This supposes
that simulated and real scene agree in texture, speed and turbulence: a rate that is wrong by 10 %
moves C by 4 to 10 %, and light taken for code values moves it nearly threefold.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.recordings.event_rates import Rates
from src.records.results import csv_text, write_text
from src.sim.sensor.sensor import EventSensor

ROUNDS = 4  # of simulating with the ratio of OFF to ON threshold found so far
GRID = tuple(np.geomspace(0.05, 2.0, 24).round(4).tolist())


@dataclass(frozen=True)
class Curve:
    """Simulated rates (thresholds, 2), ON and OFF in events / pixel / s, over the ON threshold."""

    thresholds: Float[np.ndarray, " k"]
    rates: Float[np.ndarray, "k 2"]
    off_ratio: float


@dataclass(frozen=True)
class Estimate:
    """`on` and `off` thresholds: (value, low, high), the last two an interval of 95 %."""

    on: tuple[float, float, float]
    off: tuple[float, float, float]
    curve: Curve
    rates: Float[np.ndarray, " 2"]
    interval: Float[np.ndarray, "2 2"]


def simulate(
    clips: Iterable[Float[Tensor, "views frames h w"]],
    fps: float,
    sensor: EventSensor,
    thresholds: Sequence[float] = GRID,
    *,
    off_ratio: float = 1.0,
) -> Curve:
    """Return the rates of a sensor looking at `clips`, at all thresholds with the same noise.

    Its own `threshold` and `off_ratio` are not used.
    """
    sensor = sensor.having(threshold=thresholds[0], off_ratio=off_ratio)
    grid = torch.tensor(thresholds, dtype=torch.float32)
    events, exposure = torch.zeros(len(grid), 2, dtype=torch.float64), 0.0
    for index, frames in enumerate(clips):
        views, count, h, w = frames.shape
        batch = frames.expand(len(grid), -1, -1, -1, -1)
        counts = sensor.counts(batch, fps, clips=[index] * len(grid), threshold=grid)
        events += counts.sum(1)
        exposure += views * h * w * (count - 1) / fps
    return Curve(grid.double().numpy(), (events / exposure).numpy(), off_ratio)


def estimate(
    rates: Rates,
    clips: Sequence[Float[Tensor, "views frames h w"]],
    fps: float,
    sensor: EventSensor,
    thresholds: Sequence[float] = GRID,
) -> Estimate:
    """Return the thresholds at which the sensor makes the recording's rates.

    The geometric mean of ON and OFF rate gives the size of the thresholds; their quotient gives
    the ratio of OFF to ON, because what rises has to fall: the simulation is repeated with the
    ratio found.  Raises ValueError if a rate is none that the grid makes.
    """
    wanted, drawn = rates.pooled, rates.bootstrap()
    if not (wanted > 0).all():
        raise ValueError(f"the recording's rates above the background are not positive: {wanted}")
    ratio = 1.0
    for _ in range(ROUNDS):
        curve = simulate(clips, fps, sensor, thresholds, off_ratio=ratio)
        on = invert(curve, wanted)
        if not np.isfinite(on):
            low, high = np.sqrt(np.prod(curve.rates[[-1, 0]], axis=1))
            raise ValueError(
                f"the recording's rate {np.sqrt(np.prod(wanted)):.3g} is outside what the grid of "
                f"thresholds {thresholds[0]} to {thresholds[-1]} makes, {low:.3g} to {high:.3g}"
            )
        ratio = float(np.clip(ratio * _excess(curve, on, wanted), 0.1, 10))
    pairs = np.maximum(drawn, 1e-12)
    spread_on = np.array([invert(curve, pair) for pair in pairs])
    excess = np.array([_excess(curve, c, p) for c, p in zip(spread_on, pairs, strict=True)])
    spread_off = spread_on * curve.off_ratio * excess
    bounds = [np.nanpercentile(spread, (2.5, 97.5)) for spread in (spread_on, spread_off)]
    return Estimate(
        (on, *map(float, bounds[0])),
        (on * ratio, *map(float, bounds[1])),
        curve,
        wanted,
        np.percentile(drawn, (2.5, 97.5), axis=0),
    )


def invert(curve: Curve, rates: Float[np.ndarray, " 2"]) -> float:
    """Return the ON threshold with the geometric mean of `rates`, nan where the grid ends.

    Linear in log rate over log threshold, the simulated rates made monotone first.
    """
    mean = np.sqrt(np.maximum(np.prod(curve.rates, axis=1), 1e-30))
    falling = np.minimum.accumulate(np.log(mean))
    target = 0.5 * np.log(np.prod(rates))
    thresholds = np.log(curve.thresholds)[::-1]
    return float(np.exp(np.interp(target, falling[::-1], thresholds, np.nan, np.nan)))


def _excess(curve: Curve, on: float, rates: Float[np.ndarray, " 2"]) -> float:
    """Return how much larger the quotient of ON to OFF rate is than the curve's at `on`."""
    quotient = np.log(np.maximum(curve.rates[:, 0], 1e-15) / np.maximum(curve.rates[:, 1], 1e-15))
    expected = np.interp(np.log(on), np.log(curve.thresholds), quotient)
    return float(np.exp(np.log(rates[0] / rates[1]) - expected))


def write_csv(thresholds: Estimate, rates: Rates, path: Path) -> None:
    """Write the curve, the rates of each view and the estimate as one table."""
    curve = zip(thresholds.curve.thresholds, thresholds.curve.rates, strict=True)
    rows = [("simulated_hz", f"{threshold:.4g}", *pair) for threshold, pair in curve]
    rows += [("measured_hz", index, *pair) for index, pair in enumerate(rates.per_view)]
    estimate = zip(("estimate", "low", "high"), thresholds.on, thresholds.off, strict=True)
    rows += [(name, "", on, off) for name, on, off in estimate]
    texts = [(what, which, *(f"{value:.5g}" for value in pair)) for what, which, *pair in rows]
    write_text(path, csv_text(("what", "threshold_or_view", "on", "off"), texts))
