"""Simulated air as a turbulence model (model.py): atmospheres drawn, then computed."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch

from src.sim.optics import Position
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import sample_atmosphere
from src.sim.turbulence.ranges import refused
from src.sim.turbulence.rigid import rigid_atmosphere

PRIORS = {"seen": sample_atmosphere, "rigid": rigid_atmosphere}


class SimulatedAir:
    """`atmosphere`: the `prior` that is drawn from, `seen` (prior.py) or `rigid` (rigid.py), and
    its keyword arguments; `options`: those of `Turbulence`.

    Raises ValueError for options that are unknown or outside their range.
    """

    def __init__(self, atmosphere: Mapping[str, Any], **options: Any):
        self.atmosphere, self.options = dict(atmosphere), options
        # Where none is named, a range of Cn2 says that the config is of version 0.1.
        implied = "rigid" if "cn2" in self.atmosphere else "seen"
        self.prior = self.atmosphere.pop("prior", None) or implied
        if self.prior not in PRIORS:
            raise refused("prior", f"of {', '.join(PRIORS)}", self.prior)
        try:
            Turbulence(None, views=1, height=1, width=1, **options)
        except TypeError as error:
            raise ValueError(f"turbulence takes no such values: {error}") from error

    def draw(self, generator: torch.Generator) -> Atmosphere | None:
        """Draw an atmosphere; None: no turbulence."""
        try:
            return PRIORS[self.prior](generator=generator, **self.atmosphere)
        except TypeError as error:
            raise ValueError(f"turbulence.atmosphere takes no such values: {error}") from error

    def operator(
        self,
        drawn: Atmosphere | None,
        *,
        views: Sequence[Position],
        height: int,
        width: int,
        fps: float,
    ) -> Turbulence:
        """Return the operator of an atmosphere; the last ones asked for are remembered."""
        places = tuple(tuple(position) for position in views)
        return _operator(drawn, places, height, width, fps, tuple(self.options.items()))

    def having(self, **options: Any) -> "SimulatedAir":
        """Return the same air with some of its options replaced."""
        return SimulatedAir({"prior": self.prior} | self.atmosphere, **self.options | options)


@lru_cache(maxsize=64)  # a batch is simulated, then what it was is recorded
def _operator(
    drawn: Atmosphere | None,
    views: tuple[Position, ...],
    height: int,
    width: int,
    fps: float,
    options: tuple[tuple[str, Any], ...],
) -> Turbulence:
    return Turbulence(drawn, views=views, height=height, width=width, fps=fps, **dict(options))
