"""What a loss asks of a picture from one window to the next, beside what it asks of each."""

from jaxtyping import Bool, Float
from torch import Tensor

STILL = 1 / 512  # half a grey level: a truth that changes by less stands still
FAINT = 0.02  # contrast below which changes are not counted up any more


def flicker(
    pictures: Float[Tensor, "n windows 1 h w"],
    truth: Float[Tensor, "n windows 1 h w"],
    follows: Bool[Tensor, " windows-1"],
) -> Float[Tensor, ""]:
    """Return the mean absolute change of the error over the pairs of windows that `follows`."""
    return (pictures - truth).diff(dim=1)[:, follows].abs().mean()


def unrest(
    pictures: Float[Tensor, "n windows 1 h w"],
    truth: Float[Tensor, "n windows 1 h w"],
    follows: Bool[Tensor, " windows-1"],
) -> Float[Tensor, ""]:
    """Return the mean absolute change of the pictures over the pairs of windows that `follows`,
    where the truth stands still, in units of their own contrast.

    In units of the contrast, as a fainter picture would be no calmer: an edge that is half as dark
    and changes half as much moves as far.
    """
    change = pictures.diff(dim=1)[:, follows].abs()
    still = truth.diff(dim=1)[:, follows].abs() < STILL
    contrast = (pictures.var((-2, -1), keepdim=True) + FAINT**2).sqrt()
    return (change * still / contrast[:, 1:][:, follows]).mean()
