"""How small a picture may be to run on events or outside PyTorch."""

MIN_SIDE = 8  # pixels, so that every side can be padded by reflection


def check_picture_size(height: int, width: int) -> None:
    """Raise ValueError for a side below MIN_SIDE, which names the keys of commands too."""
    if min(height, width) < MIN_SIDE:
        wanted = f">= {MIN_SIDE} px (in commands: resolution, else sensor_size)"
        raise ValueError(f"height and width must be {wanted}, got {height} and {width}")
