"""Turbulence measured in a video: the file `air.yaml`, and clips of such turbulence.

Lengths are in pixels of a frame whose smaller side is 256, times in seconds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml

from src import COMMAND
from src.records import safe_yaml
from src.sim.optics import Position
from src.sim.turbulence import prior
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import Range, TargetImageStatistics, log_uniform
from src.sim.turbulence.simulated import SimulatedTurbulence

SIDE = 256  # pixels of the smaller side of the frame that lengths are stated for
ALLOWED = {
    "tilt_rms_px": (0.001, 30.0),
    "tilt_correlation_half_length_px": (1.0, 2000.0),
    "global_tilt_share": (0.0, 1.0),
    "tilt_correlation_time_s": (0.00001, 60.0),
    "blur_px": (0.001, 30.0),
}
# Known by a bound only, or not at all.
MAY_BE_UNKNOWN = ("tilt_correlation_half_length_px", "tilt_correlation_time_s")
RENAMED = {  # keys of earlier files
    "rms_px": "tilt_rms_px",
    "half_length_px": "tilt_correlation_half_length_px",
    "whole_share": "global_tilt_share",
    "decay_s": "tilt_correlation_time_s",
}
MAX_DRAWS = 32  # of what a clip shows, until a camera shows it
WIDENING = 4.0  # times: how far beyond a bound values are drawn whose other bound is not known


class IntervalEstimate(NamedTuple):
    """A `value` with its 95 % interval; None: not known, or no bound on that side."""

    value: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        value, low, high = ("?" if x is None else f"{x:.3g}" for x in self)
        return "not known" if value == low == high == "?" else f"{value} ({low} to {high})"


@dataclass(frozen=True)
class TurbulenceFile:
    """What a video showed of its turbulence: rms of the tilt along one axis, the distance at which
    its correlation is 1/2, the share of its power that moves the whole view, its time to 1/e, and
    the blur beyond diffraction, the standard deviation of a Gaussian along one axis.

    Raises ValueError for numbers outside ALLOWED and for intervals that do not hold their value.
    """

    tilt_rms_px: IntervalEstimate
    tilt_correlation_half_length_px: IntervalEstimate
    global_tilt_share: IntervalEstimate
    tilt_correlation_time_s: IntervalEstimate
    blur_px: IntervalEstimate

    def __post_init__(self):
        for name, estimate in vars(self).items():
            low, high = ALLOWED[name]
            numbers = (estimate.low, estimate.value, estimate.high)
            for number in numbers:
                if number is None and name in MAY_BE_UNKNOWN:
                    continue
                if number is None or not low <= number <= high:
                    raise ValueError(f"{name} must be in {low:g}..{high:g}, got {number}")
            known = [number for number in numbers if number is not None]
            if known != sorted(known):
                raise ValueError(f"{name} must lie in its interval, got {estimate}")

    def to_yaml(self) -> str:
        """Return the content of the file."""
        content = {}
        for name, one in vars(self).items():
            value, *interval = (None if x is None else float(f"{x:.4g}") for x in one)
            content[name] = {"value": value, "interval": interval}
        return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def read_turbulence_file(path: Path | str | None) -> TurbulenceFile:
    """Read a file; raises ValueError, one line, for none and for one that holds something else."""
    wrong = f"turbulence.measured must be a file of `{COMMAND}calibrate task=air`, got {path}"
    if path is None:
        raise ValueError(wrong)
    try:
        content = safe_yaml.read(path)
        if isinstance(content, dict) and (former := RENAMED.keys() & content):
            renamed = ", ".join(f"{k} is now {new}" for k, new in RENAMED.items() if k in former)
            raise ValueError(f"{renamed}; their values are the same")
        if not isinstance(content, dict) or set(content) != set(ALLOWED):
            got = sorted(map(str, content)) if isinstance(content, dict) else type(content).__name__
            raise ValueError(f"its keys must be {', '.join(ALLOWED)}, got {got}")
        return TurbulenceFile(**{name: _parse_estimate(name, content[name]) for name in ALLOWED})
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{wrong}: {error}") from error


def _parse_estimate(name: str, content: Any) -> IntervalEstimate:
    complete = isinstance(content, dict) and set(content) == {"value", "interval"}
    interval = content["interval"] if complete else None
    if not isinstance(interval, list) or len(interval) != 2:
        raise ValueError(f"{name} must hold value and interval: [low, high], got {content}")
    for number in (content["value"], *interval):
        if not (number is None or type(number) in (int, float)):
            raise ValueError(f"{name} must hold numbers, got {number}")
    return IntervalEstimate(content["value"], *interval)


class MeasuredTurbulence(SimulatedTurbulence):
    """Clips of turbulence like that of `measured`, a file of `src.calibrate task=air`: what each
    shows is drawn within the intervals there, then a camera and a path that show it (prior.py).

    `atmosphere`: the ranges these are drawn from, and `tilt_correlation_time_s`, for a file that
    knows no decay; `options`: those of `Turbulence`.  Raises ValueError for wrong ones.
    """

    def __init__(self, measured: str | Path | None, atmosphere: Mapping[str, Any], **options: Any):
        super().__init__(atmosphere, **options)
        self.measured, self.file = measured, read_turbulence_file(measured)
        cameras = dict(self.atmosphere)
        unknown = cameras.pop("tilt_correlation_time_s")
        self.cameras = cameras
        self.lengths = _drawing_range(self.file.tilt_correlation_half_length_px, (5.0, 600.0))
        self.decays = _drawing_range(self.file.tilt_correlation_time_s, unknown)

    def operator(
        self, drawn: Atmosphere | None, *, views: Sequence[Position], **frames: Any
    ) -> Turbulence:
        """Return the operator of an atmosphere that was drawn for a smaller side of SIDE pixels."""
        if drawn is not None:  # an atmosphere's pixels are of the width
            height, width = frames["height"], frames["width"]
            drawn = replace(drawn, scene_width_m=drawn.scene_width_m * width / min(height, width))
        return super().operator(drawn, views=views, **frames)

    def draw(self, generator: torch.Generator) -> Atmosphere:
        """Draw an atmosphere that shows what the file says; raises ValueError where none does."""
        for _ in range(MAX_DRAWS):
            u = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
            rms, blur, share = self.file.tilt_rms_px, self.file.blur_px, self.file.global_tilt_share
            length = log_uniform(u[0], self.lengths, "tilt_correlation_half_length_px")
            time_s = log_uniform(u[1], self.decays, "tilt_correlation_time_s")
            seen = TargetImageStatistics(
                tilt_correlation_half_length_px=float(length),
                tilt_correlation_time_s=float(time_s),
                tilt_px=float(log_uniform(u[2], _bounds(rms), "tilt_rms_px")),
                blur_px=float(np.interp(u[3], (0, 1), _bounds(blur))),
                global_tilt_share=float(np.interp(u[4], (0, 1), _bounds(share))),
            )
            try:
                return prior.sample_matching_atmosphere(seen, generator, **self.cameras)
            except TypeError as error:
                raise ValueError(f"turbulence.atmosphere takes no such values: {error}") from error
            except ValueError as error:
                reason = error
        raise ValueError(f"turbulence.measured={self.measured}: {reason}")


def _drawing_range(estimate: IntervalEstimate, unknown: Range) -> Range:
    """Return the interval; a bound that is not known is WIDENING times away from the other."""
    low, high = estimate.low, estimate.high
    if low is None:
        if high is None:
            return unknown
        low = high / WIDENING
    if high is None:
        high = max(low, estimate.value or 0) * WIDENING
    return max(low, high / 1000), high


def _bounds(estimate: IntervalEstimate) -> Range:
    assert estimate.low is not None and estimate.high is not None, "TurbulenceFile checks this"
    return estimate.low, estimate.high
