"""Clean clips: photographs in motion, known targets, footage."""

from src.sim.scenes.photographs import Clip, Photographs

__all__ = ["Clip", "Photographs"]
