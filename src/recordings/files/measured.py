"""Air that was measured in footage: the file `air.yaml`, and clips of such air.

Lengths are in pixels of a frame whose smaller side is 256, times in seconds.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
import yaml

from src.recordings.files import safe_yaml
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.prior import Appearance, matching
from src.sim.turbulence.ranges import Range, between, log_between
from src.sim.turbulence.simulated import SimulatedAir

SIDE = 256  # pixels of the smaller side of the frame that lengths are stated for
ALLOWED = {
    "rms_px": (0.001, 30.0),
    "half_length_px": (1.0, 2000.0),
    "whole_share": (0.0, 1.0),
    "decay_s": (0.00001, 60.0),
    "blur_ratio": (1.0, 10.0),
}
BOUNDED = ("half_length_px", "decay_s")  # these may be known by a bound only, or not at all
# The sharpest tenth is blurred too, and so is the scene: in simulated clips of D/r0 1 to 4 a point
# grows by this many times what edges do between the sharpest tenth and a typical moment.
LUCKY = 2.8
TRIES = 32  # draws of what a clip shows, until a camera shows it
WIDE = 4.0  # times: how far beyond a bound air is drawn whose other bound is not known


@dataclass(frozen=True)
class Estimate:
    """A `value` and the interval it lies in at 95 %; None: not known, or no bound on that side."""

    value: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        if self.value is self.low is self.high is None:
            return "not known"
        numbers = (self.value, self.low, self.high)
        value, low, high = ("?" if x is None else f"{x:.3g}" for x in numbers)
        return f"{value} ({low} to {high})"


@dataclass(frozen=True)
class AirFile:
    """What footage showed of its air: rms of the tilt along one axis, the distance at which its
    correlation is 1/2, the share of its power that moves the whole view, its time to 1/e, and how
    much wider an edge is at a typical moment than in the sharpest tenth of moments.

    Raises ValueError for numbers outside ALLOWED and for intervals that do not hold their value.
    """

    rms_px: Estimate
    half_length_px: Estimate
    whole_share: Estimate
    decay_s: Estimate
    blur_ratio: Estimate

    def __post_init__(self):
        for name, one in vars(self).items():
            _check(name, one)

    def text(self) -> str:
        """Return the content of the file."""
        content = {}
        for name, one in vars(self).items():
            value, *interval = map(_rounded, (one.value, one.low, one.high))
            content[name] = {"value": value, "interval": interval}
        return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def read(path: Path | str | None) -> AirFile:
    """Read a file; raises ValueError, one line, for none and for one that holds something else."""
    wrong = f"turbulence.measured must be a file of src.calibrate task=air, got {path}"
    if path is None:
        raise ValueError(wrong)
    try:
        content = safe_yaml.read(path)
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"{wrong}: {error}") from error
    names = [part.name for part in fields(AirFile)]
    if not isinstance(content, dict) or set(content) != set(names):
        got = sorted(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{wrong}: its keys must be {', '.join(names)}, got {got}")
    try:
        return AirFile(**{name: _estimate(name, content[name]) for name in names})
    except ValueError as error:
        raise ValueError(f"{wrong}: {error}") from error


def _estimate(name: str, content: Any) -> Estimate:
    complete = isinstance(content, dict) and set(content) == {"value", "interval"}
    interval = content["interval"] if complete else None
    if not isinstance(interval, list) or len(interval) != 2:
        raise ValueError(f"{name} must hold value and interval: [low, high], got {content}")
    for number in (content["value"], *interval):
        if not (number is None or type(number) in (int, float)):
            raise ValueError(f"{name} must hold numbers, got {number}")
    return Estimate(content["value"], *interval)


def _check(name: str, one: Estimate) -> None:
    least, most = ALLOWED[name]
    numbers = (one.low, one.value, one.high)
    for number in numbers:
        if number is None and name in BOUNDED:
            continue
        good = number is not None and math.isfinite(number)
        if not (good and least <= number <= most):
            raise ValueError(f"{name} must be in {least:g}..{most:g}, got {number}")
    stated = [number for number in numbers if number is not None]
    if stated != sorted(stated):
        raise ValueError(f"{name} must lie in its interval, got {one}")


def _rounded(number: float | None) -> float | None:
    return None if number is None else float(f"{number:.4g}")


class MeasuredAir(SimulatedAir):
    """Clips of air like that of `measured`, a file of `src.calibrate task=air`: what each shows is
    drawn within the intervals there, then a camera and a path that show it (prior.py).

    `atmosphere`: the ranges these are drawn from, and `decay_s`, for a file that knows no decay;
    `options`: those of `Turbulence`.  Raises ValueError for a file with wrong values, and for
    options that are unknown or outside their range.
    """

    def __init__(self, measured: str | Path | None, atmosphere: Mapping[str, Any], **options: Any):
        super().__init__({"prior": "seen"} | dict(atmosphere), **options)
        self.measured, self.file = measured, read(measured)
        cameras = dict(self.atmosphere)
        unknown = cameras.pop("decay_s")
        self.cameras = cameras
        self.lengths = _range(self.file.half_length_px, (5.0, 600.0))
        self.decays = _range(self.file.decay_s, unknown)

    def draw(self, generator: torch.Generator) -> Atmosphere:
        """Draw what a clip shows and air that shows it; raises ValueError where no camera does."""
        for _ in range(TRIES):
            u = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
            rms, blur, share = self.file.rms_px, self.file.blur_ratio, self.file.whole_share
            seen = Appearance(
                half_length_px=float(log_between(u[0], self.lengths, "half_length_px")),
                decay_s=float(log_between(u[1], self.decays, "decay_s")),
                tilt_px=float(log_between(u[2], (rms.low, rms.high), "rms_px")),
                blur_ratio=1 + LUCKY * (between(u[3], (blur.low, blur.high), "blur_ratio") - 1),
                whole_share=between(u[4], (share.low, share.high), "whole_share"),
            )
            try:
                return matching(seen, generator, **self.cameras)
            except TypeError as error:
                raise ValueError(f"turbulence.atmosphere takes no such values: {error}") from error
            except ValueError as error:
                reason = error
        raise ValueError(f"turbulence.measured={self.measured}: {reason}")

    def having(self, **options: Any) -> "MeasuredAir":
        """Return the same air with some of its options replaced."""
        return MeasuredAir(self.measured, self.atmosphere, **self.options | options)


def _range(one: Estimate, unknown: Range) -> Range:
    """Return the interval; where a bound is not known, WIDE times away from the other."""
    if one.low is None and one.high is None:
        return unknown
    low = one.high / WIDE if one.low is None else one.low
    high = max(low, one.value or 0) * WIDE if one.high is None else one.high
    return max(low, high / 1000), high
