"""The event sensor and its engines."""

from src.sim.sensor.response import decode_srgb
from src.sim.sensor.sensor import EventSensor

__all__ = ["EventSensor", "decode_srgb"]
