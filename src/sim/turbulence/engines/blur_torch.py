"""Warp and normalised scatter of many images at once as few torch expressions, for any device.

Images are numbered: those from `first` on are given, and image i is one of frame i modulo the
number of frames, so that all views of a clip can be done together.
"""

import math
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.sim.turbulence.coefficient_grid import GridAxis
from src.sim.turbulence.psf import reflect_index

# Keys' cubic (a = -1/2): the weights of the pixels -1, 0, 1, 2 as polynomials in the place between.
CUBIC_KERNEL = (
    (0.0, -0.5, 1.0, -0.5),
    (1.0, 0.0, -2.5, 1.5),
    (0.0, 0.5, 2.0, -1.5),
    (0.0, 0.0, -0.5, 0.5),
)
WARP_NUMBERS, SCATTER_NUMBERS = 70, 3  # held at a time, for a pixel and for one of its PSF


def warp_cubic(
    frames: Float[Tensor, "frames height width"],
    tilt: Float[Tensor, "xy=2 n h w"],
    top: int,
    left: int,
    first: int = 0,
) -> Float[Tensor, "n h w"]:
    """Return frame(x - tilt(x)) over the window whose first pixel is (`top`, `left`).

    `tilt` is (x, y) in pixels.  Keys' cubic, held within each frame's own range; outside the frame
    lies its reflection.
    """
    (count, height, width), device = frames.shape, tilt.device
    away = -tilt
    whole = away.floor()
    place = (away - whole)[:, None]
    zero, one, two, three = torch.tensor(CUBIC_KERNEL, device=device).T[..., None, None, None]
    taps = torch.addcmul(zero, place, torch.addcmul(one, place, torch.addcmul(two, place, three)))
    at = whole[:, None].int() + torch.arange(-1, 3, device=device)[:, None, None, None]
    x = reflect_index(at[0] + torch.arange(left, left + tilt.shape[-1], device=device), width)
    y = torch.arange(top, top + tilt.shape[-2], device=device)[:, None]
    frame = torch.arange(first, first + tilt.shape[1], device=device) % count
    y = reflect_index(at[1] + y, height) * width + (frame * (height * width))[:, None, None]
    found = frames.take((y[:, None] + x).long())  # rows, columns, n, h, w
    light = ((found * taps[0]).sum(1) * taps[1]).sum(0)
    low, high = (limit[frame][:, None, None] for limit in torch.aminmax(frames.flatten(1), dim=1))
    return light.clamp(low, high)


def scatter_normalised(
    image: Float[Tensor, "n h w"],
    psfs: Float[Tensor, "pixels n rows w"],
    rows: GridAxis,
    halo: Float[Tensor, "frames hout wout"],
    halo_share: float,
    first: int = 0,
) -> Float[Tensor, "n hout wout"]:
    """Spread every pixel's light by the PSF there, over what a white scene would give.

    `psfs` has them pixel by pixel in every column of `rows` of nodes, what is negative stands for
    0; `halo` is the light from beyond them, `halo_share` what it would be of a white scene.
    """
    size = math.isqrt(len(psfs))
    psfs = psfs.transpose(0, 1).clamp(min=0)
    psfs = psfs if rows.pitch == 1 else rows.interpolation_matrix().to(psfs) @ psfs
    fold = partial(functional.fold, output_size=halo.shape[1:], kernel_size=size, padding=size - 1)
    white, light = fold(psfs.flatten(2)), fold((psfs * image[:, None]).flatten(2))
    frame = torch.arange(first, first + len(image), device=image.device) % len(halo)
    return (light[:, 0] + halo[frame]) / (white[:, 0] + halo_share)
