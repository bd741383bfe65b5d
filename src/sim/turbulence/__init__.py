"""Turbulence: an atmosphere as numbers, how it is drawn, and what it does to an image."""

from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import sample_atmosphere

__all__ = ["Atmosphere", "Turbulence", "sample_atmosphere"]
