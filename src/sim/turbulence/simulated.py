"""Simulated turbulence as a model (contract.py): atmospheres are drawn, then computed."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch

from src.sim.optics import Position
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import sample_atmosphere

_cached_turbulence = lru_cache(maxsize=64)(Turbulence)  # one batch is simulated, then recorded


class SimulatedTurbulence:
    """`atmosphere`: keyword arguments of `sample_atmosphere`; `options`: those of `Turbulence`.

    Raises ValueError for options that are unknown or outside their range.
    """

    def __init__(self, atmosphere: Mapping[str, Any], **options: Any):
        self.atmosphere, self.options = dict(atmosphere), options
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
