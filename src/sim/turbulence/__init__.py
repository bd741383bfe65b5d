"""Air: one atmosphere as numbers, its phase, and what it does to a picture."""

from src.sim.turbulence.operator import Turbulence

__all__ = ["Turbulence"]
