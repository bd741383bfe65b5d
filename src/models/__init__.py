"""Networks that learn here, and their files."""

from src.models.files import load, save

__all__ = ["load", "save"]
