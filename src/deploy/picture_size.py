"""How small a picture may be to run on events or outside PyTorch."""

from numbers import Integral

MIN_SIDE = 8  # pixels, so that every side can be padded by reflection


def check_picture_size(height: float, width: float) -> None:
    """Raise ValueError for a side below MIN_SIDE or no whole number, which names the keys of
    commands too."""
    are_whole = isinstance(height, Integral) and isinstance(width, Integral)
    if not are_whole or min(height, width) < MIN_SIDE:
        wanted = f">= {MIN_SIDE} px, whole (in commands: resolution, else sensor_size)"
        raise ValueError(f"height and width must be {wanted}, got {height} and {width}")
