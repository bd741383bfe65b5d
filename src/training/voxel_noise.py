"""Noise on voxel grids: Gaussian, hot pixels (Rebecq et al. 2019) and pixels that fire alone.

Every draw comes from a key; on the CPU the normals of a table cost half of torch's.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor

from src.sim import noise

PIXEL_OFFSET_STD = 0.1  # of an offset, in events
QUANTILES = ndtri((np.arange(2**16) + 0.5) / 2**16)  # of a standard normal, at equal steps
QUANTILES = (QUANTILES / QUANTILES.std()).astype(np.float32)


def draw_normals(shape: Sequence[int], key: int, device: torch.device) -> Tensor:
    """Return standard normals; on the CPU of 2^16 levels up to 4.2 away from 0.

    The devices draw other numbers from the same distribution.
    """
    if device.type != "cpu":
        generator = torch.Generator(device).manual_seed(key)
        return torch.empty(*shape, device=device).normal_(generator=generator)
    count = math.prod(shape)
    levels = np.random.SFC64(key).random_raw(-(-count // 4)).view(np.uint16)
    return torch.from_numpy(QUANTILES[levels[:count]]).reshape(*shape)


def draw_pixel_offsets(size: Sequence[int], max_fraction: float, key: int) -> Float[Tensor, "h w"]:
    """Return an image (h, w) that is zero but at up to `max_fraction` of the pixels.

    Their number is rounded up as often as its rest is large: 0.4 are one in two crops of five.
    """
    pixels = size[0] * size[1]
    share, rest = noise.uniforms(noise.key(key, "count"), 2)
    count = int(share * (max_fraction * pixels) + rest)
    image = torch.zeros(pixels)
    if count:
        places = (noise.uniform(key, torch.arange(count)) * pixels).long()
        normals = noise.normal(noise.key(key, "value"), torch.arange(count))
        image[places] = PIXEL_OFFSET_STD * normals
    return image.reshape(*size)


def add_firing_pixels(
    voxels: Tensor,
    max_fraction: float,
    events_per_window_ranges: Sequence[Sequence[float]],
    keys: list[int],
) -> None:
    """Let up to `max_fraction` of the pixels of each clip's views fire without a change of light.

    `voxels`: (n, windows, views, bins, h, w).  Each has as many events a window as a Poisson
    process with a mean log-uniform in the clip's `events_per_window_ranges` = (low, high), each ON
    or OFF.  Each bin counts whole events of its own, all bins alike.  In the bilinear grid of a hot
    pixel events are shared by two bins; of five the first and last have 5/12 of the variance found
    here, the others 5/6.
    """
    places, events = [], []
    for clip, (counts, key) in enumerate(zip(events_per_window_ranges, keys, strict=True)):
        generator = np.random.Generator(np.random.SFC64(key))
        for view in range(voxels.shape[2]):
            pixels, own = _draw_noisy_pixels(voxels.shape, max_fraction, counts, generator)
            places.append(np.stack([np.full_like(pixels[0], k) for k in (clip, view)] + [*pixels]))
            events.append(own)
    clip, view, row, column = torch.from_numpy(np.concatenate(places, 1)).to(voxels.device)
    added = torch.from_numpy(np.concatenate(events)).to(voxels)
    voxels[clip, :, view, :, row, column] += added  # no pixel is there twice


def _draw_noisy_pixels(
    shape: Sequence[int],
    max_fraction: float,
    counts: Sequence[float],
    generator: np.random.Generator,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns (2, pixels) of a view's noisy pixels, and their ON minus OFF events
    (pixels, windows, bins).
    """
    _, windows, _, bins, height, width = shape
    share, rest = generator.random(2)
    count = int(share * (max_fraction * height * width) + rest)
    pixels = generator.integers([[height], [width]], size=(2, count))
    low, high = np.log(counts)
    mean = np.exp(generator.uniform(low, high, count)) / (2 * bins)
    on, off = generator.poisson(mean, (2, windows, bins, count))
    # A pixel that is drawn twice fires as it was drawn last.
    last = count - 1 - np.unique((pixels[0] * width + pixels[1])[::-1], return_index=True)[1]
    return pixels[:, last], (on - off)[..., last].transpose(2, 0, 1)
