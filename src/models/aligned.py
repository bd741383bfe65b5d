"""Views brought together before a network sees them: each is moved back by as much as its air, or a
calibration that is off, displaces it from the mean of all views.

The leaky sum of a view's events is a picture of its edges.  It differs from the mean of all by
that mean's gradient times the displacement, which least squares so give in closed form (Lucas &
Kanade 1981), with a prior of none: where nothing has an edge, nothing is moved.  No weights.
What it wins: docs/decisions/0034-views-brought-together.md.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.metrics.temporal import gradients, pull
from src.models.unroll import unroll
from src.sim.optics import Position

WAYS = ("whole", "local")
MEMORY_S = 0.05  # time constant of the sums; the air moves on in as long
CELL, BLOCK = 2, 4  # pixels of a cell, in which events are summed; cells of a block
WIDTH = 2.0  # blocks: standard deviation of the window of `local`
PRIOR = {"whole": 0.01, "local": 0.1}  # squared gradients, in events a cell, that count as much
LARGEST = 4.0  # pixels: further off the picture is not linear any more


class Aligned(nn.Module):
    """`network`, given views that are brought together: `way` is `whole`, each view moved as one,
    or `local`, also place by place, over some 16 px.  Raises ValueError for another way and for a
    network that makes a whole video at once.
    """

    def __init__(self, network: nn.Module, way: str):
        super().__init__()
        if way not in WAYS:
            raise ValueError(f"align must be one of {', '.join(WAYS)} or null, got {way}")
        if hasattr(network, "video"):
            kind = type(network).__name__
            raise ValueError(f"align must be null for {kind}, which does not go window by window")
        self.network, self.views, self.way = network, network.views, way

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: tuple[Tensor, Any] | None = None,
        *,
        window_s: float | Tensor = 1 / 120,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], tuple[Tensor, Any]]:
        """Return the frame and the state: the sums of each view's events and the network's own."""
        frames, state = self.sequence(
            voxels[:, None], state, window_s=window_s, positions=positions
        )
        return frames[:, 0], state

    def sequence(
        self,
        voxels: Float[Tensor, "n windows views bins h w"],
        state: tuple[Tensor, Any] | None = None,
        *,
        window_s: float | Tensor = 1 / 120,
        positions: Sequence[Position] | None = None,
        shown: Sequence[int] | None = None,
    ) -> tuple[Float[Tensor, "n shown 1 h w"], tuple[Tensor, Any]]:
        """Return the frames of the windows `shown` (None: all) and the state after the last."""
        sums, own = (None, None) if state is None else state
        moved = []
        for window in voxels.unbind(1):
            sums = leaked(sums, window, window_s)
            moved.append(brought(window, displacement(sums, self.way)))
        options = {"window_s": window_s, "positions": positions, "shown": shown}
        frames, own = unroll(self.network, torch.stack(moved, 1), own, **options)
        return frames, (sums, own)


def leaked(
    sums: Float[Tensor, "n views h2 w2"] | None,
    voxels: Float[Tensor, "n views bins h w"],
    window_s: float | Tensor,
) -> Float[Tensor, "n views h2 w2"]:
    """Return the leaky sums of events in cells after a window."""
    now = voxels.float().sum(2)
    now = CELL**2 * functional.avg_pool2d(now, CELL, ceil_mode=True)
    if sums is None:
        return now
    seconds = torch.as_tensor(window_s, dtype=torch.float32, device=now.device)
    return torch.exp(-seconds.view(-1, 1, 1, 1) / MEMORY_S) * sums + now


def displacement(
    sums: Float[Tensor, "n views h2 w2"], way: str
) -> Float[Tensor, "n views 2 hb wb"]:
    """Return how far (x, y), in pixels, each view sees things from where the mean of all has them:
    one for a view, or in blocks.
    """
    moments = _moments(sums)
    whole = [part.mean((-2, -1), keepdim=True) for part in moments]
    found = _solved(whole, 0.0, 0.0, PRIOR["whole"])
    if way == "local":
        near = [_windowed(part) for part in moments]
        found = _solved(near, *found, PRIOR["local"])
    return -CELL * torch.stack(found, 2).clamp(-LARGEST / CELL, LARGEST / CELL)


def brought(
    voxels: Float[Tensor, "n views bins h w"], by: Float[Tensor, "n views 2 hb wb"]
) -> Float[Tensor, "n views bins h w"]:
    """Return the grids with what lies `by` from each pixel brought there, bilinearly."""
    n, views, _, height, width = voxels.shape
    if views == 1:
        return voxels
    fine = functional.interpolate(by.flatten(0, 1), (height, width), mode="bilinear")
    return pull(voxels.flatten(0, 1), fine.to(voxels.dtype)).unflatten(0, (n, views))


def _moments(sums: Tensor) -> Sequence[Tensor]:
    """Return, averaged over blocks, the products of the mean picture's gradient with itself and
    with what each view differs by.
    """
    mean = sums.mean(1, keepdim=True)
    across, down = gradients(mean)
    change = sums - mean
    products = (across**2, across * down, down**2, across * change, down * change)
    block = min(BLOCK, *sums.shape[-2:])
    return [functional.avg_pool2d(part, block, ceil_mode=True) for part in products]


def _solved(
    moments: Sequence[Tensor], x: Tensor | float, y: Tensor | float, prior: float
) -> tuple[Tensor, Tensor]:
    """Return the displacement, in cells, of least squares and of `prior` towards (x, y)."""
    xx, xy, yy, xt, yt = moments
    xx, yy, xt, yt = xx + prior, yy + prior, xt + prior * x, yt + prior * y
    determinant = xx * yy - xy**2
    return (yy * xt - xy * yt) / determinant, (xx * yt - xy * xt) / determinant


def _windowed(x: Tensor) -> Tensor:
    """Return the mean of `x` over a Gaussian window; what lies outside does not count."""
    reach = math.ceil(2.5 * WIDTH)
    places = torch.arange(-reach, reach + 1, device=x.device)
    kernel = torch.exp(-(places.float() ** 2) / (2 * WIDTH**2))

    def blurred(part: Tensor) -> Tensor:
        part = functional.conv2d(part, kernel.view(1, 1, 1, -1), padding=(0, reach))
        return functional.conv2d(part, kernel.view(1, 1, -1, 1), padding=(reach, 0))

    flat = x.reshape(-1, 1, *x.shape[-2:])
    return (blurred(flat) / blurred(torch.ones_like(flat[:1]))).reshape(x.shape)
