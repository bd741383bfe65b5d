"""Simulated air as a turbulence model (model.py): atmospheres drawn, then computed."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from src.sim.optics import Position
from src.sim.turbulence.atmosphere import Atmosphere, sample_atmosphere
from src.sim.turbulence.operator import Turbulence

WEAK_SCATTER = 0.3  # Rytov variance up to which phase alone will do (Andrews & Phillips 2005)


class SimulatedAir:
    """`atmosphere`: keyword arguments of `sample_atmosphere`; `options`: those of `Turbulence`.

    Raises ValueError for options that are unknown or outside their range.
    """

    def __init__(self, atmosphere: Mapping[str, Any], **options: Any):
        self.atmosphere, self.options = dict(atmosphere), options
        self.warned = False
        try:
            Turbulence(None, views=1, height=1, width=1, **options)
        except TypeError as error:
            raise ValueError(f"turbulence takes no such values: {error}") from error

    def draw(self, generator: torch.Generator) -> Atmosphere | None:
        """Draw an atmosphere; None: no turbulence."""
        try:
            atmosphere = sample_atmosphere(generator=generator, **self.atmosphere)
        except TypeError as error:
            raise ValueError(f"turbulence.atmosphere takes no such values: {error}") from error
        self._check_scatter(atmosphere)
        return atmosphere

    def operator(
        self,
        drawn: Atmosphere | None,
        *,
        views: Sequence[Position],
        height: int,
        width: int,
        fps: float,
    ) -> Turbulence:
        """Return the operator of an atmosphere."""
        return Turbulence(drawn, views=views, height=height, width=width, fps=fps, **self.options)

    def _check_scatter(self, atmosphere: Atmosphere | None) -> None:
        """Warn, once, of an atmosphere that phase alone does not describe."""
        if atmosphere is None or self.warned or atmosphere.rytov <= WEAK_SCATTER:
            return
        self.warned = True
        warnings.warn(
            f"turbulence.atmosphere: a Rytov variance of {atmosphere.rytov:.2f} is above "
            f"{WEAK_SCATTER}: scintillation, which is left out, matters there",
            stacklevel=3,
        )

    def having(self, **options: Any) -> "SimulatedAir":
        """Return the same air with some of its options replaced."""
        return SimulatedAir(self.atmosphere, **self.options | options)
