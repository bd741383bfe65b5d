"""The background of SetNet's frames: the brightness of what no event has revealed yet."""

from jaxtyping import Float
from torch import Tensor

REVEALING_EVENTS = 0.05  # supported events per cell so far, at which a frame is half the background
REVEALING_S = 0.02  # the same in seconds of a moving camera
BACKGROUND = 0.45  # brightness of what no event has revealed, before anything is
BACKGROUND_WEIGHT = 1  # of BACKGROUND in the mean of blend_background


def blend_background(
    pixels: Float[Tensor, "m pixels h2 w2"], revealed: Float[Tensor, "m 1 h2 w2"]
) -> Float[Tensor, "m pixels h2 w2"]:
    """Return the pixels of each cell as far as it is `revealed`, in [0, 1], the rest of it with the
    mean brightness of cells that are so in part: r (1 - r) is their weight.
    """
    weight = revealed * (1 - revealed)
    light = (weight * pixels.mean(1, keepdim=True)).sum((2, 3), keepdim=True)
    total = weight.sum((2, 3), keepdim=True) + BACKGROUND_WEIGHT
    background = (light + BACKGROUND_WEIGHT * BACKGROUND) / total
    return background + revealed * (pixels - background)
