"""Air: one atmosphere as numbers, how it is drawn, its phase, and what it does to a picture."""

from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.prior import sample_atmosphere

__all__ = ["Atmosphere", "Turbulence", "sample_atmosphere"]
