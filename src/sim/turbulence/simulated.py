"""Simulated turbulence as a model (contract.py): atmospheres are drawn, then computed."""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch

from src.sim.checks import check_in_range, is_range
from src.sim.optics import Position
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.contract import check_option
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import (
    TILT_AND_BLUR_PX,
    sample_atmosphere,
    unnormalised_cn2_profile,
)
from src.sim.turbulence.prior_trial import check_reachable_ranges

INTERVALS = {  # of `sample_atmosphere`: where the ends of its ranges lie
    "tilt_correlation_half_length_px": (0.01, 1e6),
    "global_tilt_half_length_px": (0.01, 1e6),
    "tilt_correlation_time_s": (1e-6, 1e6),
    "lambda_over_d_px": (0.001, 1000),
    "allowed_aperture_px": (0, math.inf),
    "outer_scale_over_aperture": (0.001, 1e6),
    "distance_m": (0.001, 1e6),
    "f_number": (0.1, 1e4),
} | {f"tilt_and_blur_px.{severity}": (0.001, 1000) for severity in TILT_AND_BLUR_PX}
NUMBERS = {
    "global_tilt_probability": (0, 1),
    "kolmogorov_probability": (0, 1),
    "max_rytov_variance": (1e-6, math.inf),
    "wavelength_m": (1e-7, 1e-4),
    "width_px": (1, 1e5),
}
_cached_turbulence = lru_cache(maxsize=64)(Turbulence)  # one batch is simulated, then recorded


class SimulatedTurbulence:
    """`atmosphere`: keyword arguments of `sample_atmosphere`; `options`: those of `Turbulence`.

    Raises ValueError for what is unknown or outside its range, also where no clip draws it, and for
    ranges of which cameras show too little (prior_trial.py).
    """

    def __init__(self, atmosphere: Mapping[str, Any], **options: Any):
        self.atmosphere, self.options = dict(atmosphere), options
        check_atmosphere_settings(self.atmosphere)
        try:
            check_reachable_ranges(self.atmosphere)
        except TypeError as error:
            raise ValueError(f"turbulence.atmosphere takes no such values: {error}") from error
        try:
            Turbulence(None, views=1, height=1, width=1, **options)
        except TypeError as error:
            raise ValueError(f"turbulence takes no such values: {error}") from error

    def draw(self, generator: torch.Generator) -> Atmosphere | None:
        """Draw an atmosphere; None: no turbulence."""
        try:
            return sample_atmosphere(generator=generator, **self.atmosphere)
        except TypeError as error:
            raise ValueError(f"turbulence.atmosphere takes no such values: {error}") from error

    def operator(
        self, drawn: Atmosphere | None, *, views: Sequence[Position], **frames: Any
    ) -> Turbulence:
        """Return the operator of an atmosphere; the last ones are cached."""
        places = tuple(tuple(position) for position in views)
        return _cached_turbulence(drawn, views=places, **frames, **self.options)


def check_atmosphere_settings(settings: Mapping[str, Any]) -> None:
    """Raise ValueError for the first of `sample_atmosphere`'s settings outside its range."""
    spreads = settings.get("tilt_and_blur_px") or {}
    given = {**settings, **{f"tilt_and_blur_px.{key}": ends for key, ends in spreads.items()}}
    for name in INTERVALS.keys() & given:
        ends, (least, most) = given[name], INTERVALS[name]
        valid = is_range(ends) and least <= ends[0] and ends[1] <= most
        allowed = f"a range {least:g} <= low <= high <= {most:g}"
        check_option(valid, f"atmosphere.{name}", allowed, ends)
    for name in NUMBERS.keys() & given:
        check_in_range(f"turbulence.atmosphere.{name}", given[name], *NUMBERS[name])
    profiles = given.get("cn2_profiles", ["uniform"])
    valid = isinstance(profiles, Sequence) and len(profiles) > 0
    check_option(valid, "atmosphere.cn2_profiles", "a list of names or tables", profiles)
    for profile in profiles:
        unnormalised_cn2_profile(profile)
