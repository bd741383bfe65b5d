"""Warp and normalised scatter of many pictures at once as two kernels (Triton) for CUDA.

They take what blur_torch.py takes, and give the same but for float32 rounding.
"""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.sim.turbulence.coefficient_grid import GridAxis

WARP_NUMBERS, SCATTER_NUMBERS = 8, 0  # held at a time, for a pixel and for one of its PSF
BLOCK = 256  # pixels of a program


def warp_cubic(frames: Tensor, tilt: Tensor, top: int, left: int, first: int = 0) -> Tensor:
    _, n, height, width = tilt.shape
    out = tilt.new_empty(n, height, width)
    low, high = torch.aminmax(frames.flatten(1), dim=1)
    with torch.cuda.device_of(out):
        _warp[(triton.cdiv(height * width, BLOCK), n)](
            frames.contiguous(), tilt.contiguous(), low, high, out, *frames.shape, n, height, width,
            top, left, first, BLOCK,
        )  # fmt: skip
    return out


def scatter_normalised(
    image: Tensor, psfs: Tensor, rows: GridAxis, halo: Tensor, halo_share: float, first: int = 0
) -> Tensor:
    (frames, height, width), n = halo.shape, len(image)
    out = image.new_empty(n, height, width)
    with torch.cuda.device_of(out):
        _scatter[(triton.cdiv(out.numel(), BLOCK),)](
            image.contiguous(), psfs.contiguous(), halo.contiguous(), out, halo_share, frames, n,
            height, width, psfs.shape[2], rows.pitch, rows.offset_from_first_node_px, first,
            math.isqrt(len(psfs)), rows.pitch > 1, BLOCK,
        )  # fmt: skip
    return out


# No whole number is worth another compilation.
_WARP_INTEGERS = ["frames", "rows", "columns", "n", "height", "width", "top", "left", "first"]
_SCATTER_INTEGERS = ["frames", "n", "height", "width", "rows", "pitch", "offset", "first", "size"]


@triton.jit(do_not_specialize=_WARP_INTEGERS)
def _warp(
    light, tilt, lows, highs, out, frames, rows, columns, n, height, width, top, left, first,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Warp BLOCK pixels of one picture."""
    picture, pixels = tl.program_id(1).to(tl.int64), height * width
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    own = i < pixels
    frame = (first + picture) % frames
    x, late = _along(tilt + picture * pixels + i, own, i % width + left)
    y, down = _along(tilt + (n + picture) * pixels + i, own, i // width + top)
    light += frame * rows * columns
    total = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(4):
        row = light + _reflect(y + (k - 1), rows) * columns
        line = tl.zeros([BLOCK], tl.float32)
        for m in tl.static_range(4):
            line += _tap(m, late) * tl.load(row + _reflect(x + (m - 1), columns), own, 0.0)
        total += _tap(k, down) * line
    low, high = tl.load(lows + frame), tl.load(highs + frame)
    tl.store(out + picture * pixels + i, tl.minimum(tl.maximum(total, low), high), own)


@triton.jit
def _along(tilt, own, place):
    """Return the pixel before the place that is seen along one axis, and how far it lies behind."""
    away = -tl.load(tilt, own, 0.0)
    whole = tl.floor(away)
    return whole.to(tl.int32) + place, away - whole


@triton.jit
def _tap(k: tl.constexpr, t):
    """Return Keys' weight of pixel k - 1 at `t` in [0, 1]."""
    if k == 0:
        return 0.5 * t * (t * (2 - t) - 1)
    elif k == 1:
        return 1 + 0.5 * t * t * (3 * t - 5)
    elif k == 2:
        return 0.5 * t * (t * (4 - 3 * t) + 1)
    else:
        return 0.5 * t * t * (t - 1)


@triton.jit
def _reflect(index, size):
    """Return the pixel whose mirror image lies at `index`; % keeps the sign here."""
    folded = (index % (2 * size) + 2 * size) % (2 * size)
    return tl.minimum(folded, 2 * size - 1 - folded)


@triton.jit(do_not_specialize=_SCATTER_INTEGERS)
def _scatter(
    image, psfs, halo, out, share, frames, n, height, width, rows, pitch, offset, first, size,
    BETWEEN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gather the light of BLOCK pixels, of any pictures, from all sources around."""
    across, down = width + size - 1, height + size - 1  # of a picture of sources
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    own = i < n.to(tl.int64) * height * width
    i = tl.where(own, i, 0)
    x, y, picture = i % width, i // width % height, i // width // height
    plane = n.to(tl.int64) * rows * across
    light, white = tl.zeros([BLOCK], tl.float32), tl.full([BLOCK], share, tl.float32)
    for v in range(0, size):
        row = y + size - 1 - v
        source, node, late = image + (picture * down + row) * across + x, row, light
        if BETWEEN:
            node = (row + offset) // pitch
            late = (row + offset - node * pitch).to(tl.float32) / pitch
        spots = psfs + v * size * plane + (picture * rows + node) * across + x
        for u in range(0, size):
            at = size - 1 - u
            psf = tl.maximum(tl.load(spots + at), 0.0)
            if BETWEEN:
                psf += late * (tl.maximum(tl.load(spots + across + at), 0.0) - psf)
            light += psf * tl.load(source + at)
            white += psf
            spots += plane
    light += tl.load(halo + ((first + picture) % frames * height + y) * width + x)
    tl.store(out + i, light / white, own)
