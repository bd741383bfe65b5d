"""The event sensor and its engines."""

from src.sim.sensor.sensor import EventSensor, decode_srgb

__all__ = ["EventSensor", "decode_srgb"]
