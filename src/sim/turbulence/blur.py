"""What turbulence does to a picture: tilt first, then blur, as light is scattered.

Chan 2022 (arXiv 2207.06377): tilt, then blur; Chimitt et al. 2023 (arXiv 2303.05687): every point
spreads its light by the PSF it sees.  The sum is divided by what a white scene would give, as the
radiance of an endless uniform scene survives a medium that only bends light: flat stays flat.
Outside the frame the scene is its reflection.  On the CPU the two steps are compiled
(src/sim/engines), elsewhere they are the torch expressions below; one pixel more or less of float32
rounding is all they differ by.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from src.sim.turbulence.engines import scatter as scatter_engine
from src.sim.turbulence.engines import warp as warp_engine
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.p2s import Spots

PIXELS = np.empty((0, 0, 0), np.float32), np.empty(0, np.int64)  # PSFs given pixel by pixel


def degrade(
    frames: Float[Tensor, "frames height width"],
    tilt: Float[Tensor, "2 frames h w"],
    nodes: Float[Tensor, "numbers frames rows columns"],
    size: int,
    spots: Spots | None,
    rows: Lattice,
    columns: Lattice,
    halo: Float[Tensor, "frames hout wout"],
    share: float,
) -> Float[Tensor, "frames hout wout"]:
    """Warp the frames by `tilt` in pixels, then scatter them by PSFs and add their `halo`.

    The window is that of `rows` and `columns`; on their `nodes` stands what the PSFs, `size` pixels
    across, are: weights for `spots` or, without them, every pixel.  The result lacks size // 2
    pixels on each side.  The halo of a white scene would be `share`.
    """
    if frames.device.type != "cpu":
        tilted = warp(frames, tilt, rows.start, columns.start)
        lines = nodes @ columns.weights().T.to(nodes)
        psfs = spots.psfs(lines) if spots else lines
        return scatter(tilted, psfs, rows.weights().to(tilt), halo, share)
    shapes = (spots.quarter, spots.ends) if spots else PIXELS
    place = (rows.offset, columns.offset, rows.pitch)
    light = []
    for index in range(len(frames)):
        at = (index, rows.start, columns.start)
        tilted = warp_engine.warp(frames[index].numpy(), tilt.numpy(), *at)
        if size > 1 or share > 0:
            psfs = (nodes.numpy(), index, size, *shapes, *place)
            tilted = scatter_engine.scatter(tilted, *psfs, halo[index].numpy(), share)
        light.append(torch.from_numpy(tilted))
    return torch.stack(light)


def warp(
    frames: Float[Tensor, "frames height width"],
    tilt: Float[Tensor, "2 frames h w"],
    top: int,
    left: int,
) -> Float[Tensor, "frames h w"]:
    """Return frame(x - tilt(x)) over the window whose first pixel is (`top`, `left`).

    Keys' cubic (a = -1/2), held within each frame's own range.
    """
    height, width = frames.shape[-2:]
    rows = torch.arange(tilt.shape[-2], device=tilt.device)[:, None] + top
    columns = torch.arange(tilt.shape[-1], device=tilt.device) + left
    x, y = columns - tilt[0], rows - tilt[1]
    r, c = y.floor(), x.floor()
    down, across = _keys(y - r), _keys(x - c)
    flat = frames.flatten(1)
    total = torch.zeros_like(x)
    for k in range(4):
        row = reflect(r.long() + k - 1, height) * width
        for m in range(4):
            index = row + reflect(c.long() + m - 1, width)
            total += down[k] * across[m] * flat.gather(1, index.flatten(1)).reshape(x.shape)
    return total.clamp(*(limit[:, None, None] for limit in torch.aminmax(flat, dim=1)))


def scatter(
    image: Float[Tensor, "frames h w"],
    psfs: Float[Tensor, "pixels frames rows w"],
    vertical: Float[Tensor, "h rows"],
    halo: Float[Tensor, "frames hout wout"],
    share: float,
) -> Float[Tensor, "frames hout wout"]:
    """Spread every pixel's light by the PSF there, over what a white scene would give.

    `vertical` interpolates the PSFs between rows of nodes; `halo` is the light from beyond them,
    `share` what it would be of a white scene.
    """
    size = math.isqrt(len(psfs))
    height, width = halo.shape[-2:]
    light, white = halo.clone(), torch.full_like(halo, share)
    for v in range(size):
        rows = slice(size - 1 - v, size - 1 - v + height)
        for u in range(size):
            columns = slice(size - 1 - u, size - 1 - u + width)
            share = vertical[rows] @ psfs[v * size + u, :, :, columns]
            light += share * image[:, rows, columns]
            white += share
    return light / white


def reflect(index: Int[Tensor, "..."], size: int) -> Int[Tensor, "..."]:
    """Return the pixel of the frame whose mirror image lies at `index` (the border is doubled)."""
    folded = torch.remainder(index, 2 * size)
    return torch.minimum(folded, 2 * size - 1 - folded)


def _keys(t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the weights of the pixels -1, 0, 1, 2 at `t` in [0, 1) (Keys 1981)."""
    return (
        0.5 * t * (t * (2 - t) - 1),
        1 + 0.5 * t * t * (3 * t - 5),
        0.5 * t * (t * (4 - 3 * t) + 1),
        0.5 * t * t * (t - 1),
    )
