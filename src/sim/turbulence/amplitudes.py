"""What a clip's plane waves (phase.py) do: their amplitudes in every view and frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import Position, view_id
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.phase import Waves, evolve, flow, look_from
from src.sim.turbulence.ranges import require

TEMPORAL = ("ar1", "flow", "mixed")
OWN_WIND = 0.5  # rms of a layer's own wind over the wind that all layers share


@dataclass(frozen=True)
class Motion:
    """How air moves and what the views share of it: options of `Turbulence`, of these names.

    Raises ValueError for values outside their range.
    """

    temporal: str = "ar1"
    wind_m_s: float | None = None
    wind_layers: int = 4
    views_correlation: str = "independent"
    baseline_m: float | None = None

    def __post_init__(self):
        require(self.temporal in TEMPORAL, "temporal", "ar1, flow or mixed", self.temporal)
        valid = self.wind_m_s is None or 0 <= self.wind_m_s < math.inf
        require(valid, "wind_m_s", ">= 0 or null", self.wind_m_s)
        require(1 <= self.wind_layers <= 100, "wind_layers", "in [1, 100]", self.wind_layers)
        known = self.views_correlation in ("independent", "baseline")
        require(known, "views_correlation", "independent or baseline", self.views_correlation)
        valid = self.baseline_m is None or 0 <= self.baseline_m < math.inf
        require(valid, "baseline_m", ">= 0", self.baseline_m)

    def amplitudes(
        self,
        atmosphere: Atmosphere,
        waves: Waves,
        key: int,
        *,
        positions: Sequence[Position],
        frames: int,
        fps: float,
        alpha: float,
        device: torch.device | str = "cpu",
    ) -> Complex[Tensor, "views frames waves"]:
        """Return complex64, drawn on `device`; `alpha`: what `ar1` keeps from frame to frame.

        Every view counts from its own id, or all from 0 where they share the air.
        """
        shared = self.views_correlation == "baseline"
        ids = torch.tensor([0 if shared else view_id(position) for position in positions])
        flows = self.flows(key)
        drawn = 1 if flows else frames
        counters = torch.arange(drawn * 2 * len(waves.place), device=device).reshape(drawn, -1, 2)
        counters = counters + (ids << 40).to(device)[:, None, None, None]
        fresh = noise.normal(noise.key(key, "phase"), counters).double()
        if flows:
            times = torch.arange(frames, device=device).double() / fps
            c = flow(waves, fresh, self._winds(key, atmosphere), times)
        else:
            c = evolve(fresh, alpha)
        if shared:
            pitch = atmosphere.aperture_m if self.baseline_m is None else self.baseline_m
            away = torch.tensor(positions, dtype=torch.float64).flip(-1) * pitch
            c = c * look_from(waves, away).to(device)[:, None]
        return c.to(torch.complex64)

    def flows(self, key: int) -> bool:
        """Return whether the wind carries the turbulence of this clip."""
        if self.temporal != "mixed":
            return self.temporal == "flow"
        return float(noise.uniform(noise.key(key, "temporal"), torch.tensor(0))) < 0.5

    def _winds(self, key: int, atmosphere: Atmosphere) -> Float[Tensor, "layers 2"]:
        """Return the wind (x, y) of each layer in m/s: a common one, half as much of its own.

        The mean square is that of `wind_m_s`; a single layer has that very speed.
        """
        speed = atmosphere.wind_m_s if self.wind_m_s is None else self.wind_m_s
        turn = 2 * math.pi * float(noise.uniform(noise.key(key, "wind"), torch.tensor(0)))
        common = torch.tensor([math.cos(turn), math.sin(turn)], dtype=torch.float64)
        if self.wind_layers == 1:
            return speed * common[None]
        counters = torch.arange(2 * self.wind_layers).reshape(-1, 2)
        own = noise.normal(noise.key(key, "winds"), counters).double() * OWN_WIND / math.sqrt(2)
        return speed / math.sqrt(1 + OWN_WIND**2) * (common + own)
