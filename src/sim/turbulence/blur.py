"""What turbulence does to a picture: tilt first, then blur, as light is scattered.

Chan 2022 (arXiv 2207.06377): tilt, then blur; Chimitt et al. 2023 (arXiv 2303.05687): every point
spreads its light by the PSF it sees.  The sum is divided by what a white scene would give, as the
radiance of an endless uniform scene survives a medium that only bends light: flat stays flat.
Outside the frame the scene is its reflection.  On the CPU the two steps are compiled, a view at a
time (engines/warp.py, engines/scatter.py); a device does all views at once, in Triton's kernels
(blur_triton.py) or plain torch (blur_eager.py).  They differ by float32 rounding only.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.turbulence.engines import blur_engine
from src.sim.turbulence.engines import scatter as scatter_engine
from src.sim.turbulence.engines import warp as warp_engine
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.p2s import Spots

PIXELS = np.empty((0, 0, 0), np.float32), np.empty(0, np.int64)  # PSFs given pixel by pixel


class Pictures(NamedTuple):
    """Frames as the CPU's engines take them: with a margin of their reflection, and the `low` and
    the `high` end of each one's range.
    """

    frames: Float[np.ndarray, "frames height width"]
    low: Float[np.ndarray, " frames"]
    high: Float[np.ndarray, " frames"]


def pictures(frames: Float[Tensor, "frames height width"]) -> Pictures:
    """Return the frames of a clip for `degrade`."""
    margin, known = (warp_engine.MARGIN,) * 2, frames.numpy()
    wide = np.pad(known, ((0, 0), margin, margin), mode="symmetric")
    return Pictures(wide, known.min((1, 2)), known.max((1, 2)))


def degrade(
    shown: Pictures,
    first: int,
    tilt: Float[Tensor, "2 frames h w"],
    nodes: Float[Tensor, "numbers frames rows columns"],
    size: int,
    spots: Spots | None,
    rows: Lattice,
    columns: Lattice,
    halo: Float[Tensor, "frames hout wout"],
    share: float,
) -> Float[Tensor, "frames hout wout"]:
    """Warp the frames from `first` on by `tilt` in pixels, then scatter them by PSFs and add their
    `halo`; on the CPU.

    The window is that of `rows` and `columns`; on their `nodes` stands what the PSFs, `size` pixels
    across, are: weights for `spots` or, without them, every pixel.  The result lacks size // 2
    pixels on each side.  The halo of a white scene would be `share`.
    """
    shapes = (spots.quarter, spots.ends) if spots else PIXELS
    place = (rows.offset, columns.offset, rows.pitch)
    light = []
    for index in range(tilt.shape[1]):
        frame, low, high = (part[first + index] for part in shown)
        at = (index, rows.start, columns.start)
        tilted = warp_engine.warp(frame, tilt.numpy(), *at, low, high)
        if size > 1 or share > 0:
            psfs = (nodes.numpy(), index, size, *shapes, *place)
            tilted = scatter_engine.scatter(tilted, *psfs, halo[index].numpy(), share)
        light.append(torch.from_numpy(tilted))
    return torch.stack(light)


def at_once(
    frames: Float[Tensor, "frames height width"],
    tilt: Float[Tensor, "2 n h w"],
    psfs: Float[Tensor, "pixels n rows w"],
    rows: Lattice,
    columns: Lattice,
    halo: Float[Tensor, "frames hout wout"],
    share: float,
    first: int = 0,
) -> Float[Tensor, "n hout wout"]:
    """Do the same for `n` pictures at once, on the device where they are.

    Picture i, the first being number `first`, is of frame i modulo their number; `psfs` has the
    PSFs pixel by pixel in every column of `rows` of nodes, what is negative stands for 0.
    """
    engine = blur_engine.on(frames.device)
    tilted = engine.warp(frames, tilt, rows.start, columns.start, first)
    if len(psfs) == 1 and share == 0:
        return tilted
    return engine.scatter(tilted, psfs, rows, halo, share, first)
