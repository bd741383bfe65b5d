"""Sampling on lattices, warping and scattering of images: tilt first, then blur.

A lattice holds every `pitch`-th pixel of an endless picture, pixel 0 being the frame's first; what
lies between its nodes is interpolated by cubics.  Outside the frame the scene is its reflection.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

Nodes = tuple[int, int]  # first node and number of nodes of a lattice along one axis


def nodes_for(start: int, count: int, pitch: int) -> Nodes:
    """Return the nodes that cubics need to cover pixels start .. start + count - 1."""
    if pitch == 1:
        return start, count
    first = start // pitch - 1
    return first, (start + count - 1) // pitch + 2 - first + 1


def interpolation(start: int, count: int, pitch: int) -> Float[Tensor, "count nodes"]:
    """Return the weights of the nodes in the pixels (four-point Lagrange cubic; rows sum to 1)."""
    first, number = nodes_for(start, count, pitch)
    pixel = torch.arange(start, start + count, dtype=torch.float64)
    if pitch == 1:
        return torch.eye(count, dtype=torch.float64)
    cell = torch.div(pixel, pitch, rounding_mode="floor")
    t = pixel / pitch - cell
    taps = torch.stack(
        [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ],
        dim=-1,
    )
    columns = (cell.long() - first)[:, None] + torch.arange(-1, 3)
    return torch.zeros(count, number, dtype=torch.float64).scatter_(1, columns, taps)


def warp(
    frames: Float[Tensor, "b h w"],
    tilt: Float[Tensor, "b 2 rows columns"],
    top: int,
    left: int,
) -> Float[Tensor, "b rows columns"]:
    """Return the scene as the tilt shows it: at pixel x the frame's value at x - tilt (bilinear).

    `tilt` is (x, y) in pixels over the window whose first pixel is (`top`, `left`) of the frame.
    """
    height, width = frames.shape[-2:]
    rows = torch.arange(tilt.shape[-2], device=tilt.device)[:, None] + top
    columns = torch.arange(tilt.shape[-1], device=tilt.device) + left
    x, y = columns - tilt[:, 0], rows - tilt[:, 1]
    x0, y0 = x.floor(), y.floor()
    u, v = x - x0, y - y0
    flat = frames.reshape(len(frames), -1)

    def pick(row: Tensor, column: Tensor) -> Tensor:
        index = reflect(row.long(), height) * width + reflect(column.long(), width)
        return flat.gather(1, index.reshape(len(flat), -1)).reshape(index.shape)

    above = pick(y0, x0) * (1 - u) + pick(y0, x0 + 1) * u
    below = pick(y0 + 1, x0) * (1 - u) + pick(y0 + 1, x0 + 1) * u
    return above * (1 - v) + below * v


def reflect(index: Int[Tensor, "..."], size: int) -> Int[Tensor, "..."]:
    """Return the pixel of the frame whose mirror image lies at `index` (the border is doubled)."""
    folded = torch.remainder(index, 2 * size)
    return torch.minimum(folded, 2 * size - 1 - folded)


def scatter(
    image: Float[Tensor, "b h w"],
    psfs: Float[Tensor, "b rows columns k k"],
    vertical: Float[Tensor, "h rows"],
    horizontal: Float[Tensor, "w columns"],
) -> Float[Tensor, "b hout wout"]:
    """Spread every pixel's light by the PSF there, and divide by what a white scene would give.

    The PSFs stand on lattice nodes; `vertical` and `horizontal` interpolate them.  The result lacks
    the outermost k // 2 pixels on each side, which light from outside the window would reach.
    """
    size = psfs.shape[-1]
    height, width = image.shape[-2] - size + 1, image.shape[-1] - size + 1
    light = image.new_zeros(len(image), height, width)
    white = torch.zeros_like(light)
    for row in range(size):
        for column in range(size):
            share = vertical @ psfs[..., row, column] @ horizontal.T
            window = (
                slice(None),
                slice(size - 1 - row, size - 1 - row + height),
                slice(size - 1 - column, size - 1 - column + width),
            )
            light += share[window] * image[window]
            white += share[window]
    return light / white
