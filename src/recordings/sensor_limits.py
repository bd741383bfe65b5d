"""What the sides of a sensor may be, by itself: it is read without the readers of recordings."""

LARGEST_SIDE = 8192  # pixels
