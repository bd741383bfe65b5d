"""What is added to voxel grids: Gaussian noise, hot pixels (Rebecq et al. 2019), firing pixels."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor

from src.sim import noise


def normals(shape: Sequence[int], key: int, device: torch.device) -> Tensor:
    """Return standard normals; on the CPU of 2^16 levels up to 4.2 away from 0, at half the cost.

    The devices draw other numbers from the same distribution.
    """
    if device.type != "cpu":
        drawer = torch.Generator(device).manual_seed(key)
        return torch.empty(shape, device=device).normal_(generator=drawer)
    count = math.prod(shape)
    words = np.random.SFC64(key).random_raw(-(-count // 4)).view(np.uint16)
    return torch.from_numpy(QUANTILES[words[:count]]).reshape(shape)


def quantiles(levels: int) -> NDArray[np.float32]:
    """Return the standard normal's quantiles at equal steps, of deviation 1 in all."""
    values = ndtri((np.arange(levels) + 0.5) / levels)
    return (values / values.std()).astype(np.float32)


QUANTILES = quantiles(2**16)


def hot_pixels(size: Sequence[int], fraction: float, std: float, key: int) -> Float[Tensor, "h w"]:
    """Return a picture (h, w) that is zero but at up to `fraction` of the pixels."""
    pixels = size[0] * size[1]
    count = up_to(fraction * pixels, *noise.uniforms(noise.key(key, "count"), 2))
    picture = torch.zeros(pixels)
    if count == 0:
        return picture.reshape(*size)
    places = (noise.uniform(key, torch.arange(count)) * pixels).long()
    picture[places] = std * noise.normal(noise.key(key, "value"), torch.arange(count))
    return picture.reshape(*size)


def up_to(most: float, share: float, part: float) -> int:
    """Return a number of pixels uniform in [0, most], for `share` and `part` uniform in [0, 1).

    Rounded up as often as what is over is large: 0.4 pixels are one in two crops of five, not none.
    """
    return int(share * most + part)


def fire(
    voxels: Float[Tensor, "n windows views bins h w"],
    fraction: float,
    often: Sequence[Sequence[float]],
    keys: Sequence[int],
) -> None:
    """Let up to `fraction` of the pixels of each clip's views fire on their own: in a window each
    has as many events as a Poisson process of a mean log-uniform in the clip's `often` = (low,
    high), each ON or OFF.
    """
    if fraction == 0:
        return
    places, counts = [], []
    for clip, (rates, key) in enumerate(zip(often, keys, strict=True)):
        for view, (pixels, events) in enumerate(_firing(voxels.shape, fraction, rates, key)):
            places.append(
                np.stack([np.full_like(pixels[0], clip), np.full_like(pixels[0], view), *pixels])
            )
            counts.append(events)
    clip, view, row, column = torch.from_numpy(np.concatenate(places, 1)).to(voxels.device)
    events = torch.from_numpy(np.concatenate(counts)).to(voxels)
    voxels[clip, :, view, :, row, column] += events  # no pixel is there twice


def _firing(
    shape: Sequence[int], fraction: float, often: Sequence[float], key: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield rows and columns (2, pixels) of each view's firing pixels, and ON minus OFF events
    (pixels, windows, bins).
    """
    _, windows, views, bins, height, width = shape
    drawer = np.random.Generator(np.random.SFC64(key))
    for _ in range(views):
        count = up_to(fraction * height * width, *drawer.random(2))
        pixels = drawer.integers([[height], [width]], size=(2, count))
        mean = np.exp(drawer.uniform(*np.log(often), count)) / (2 * bins)
        on, off = drawer.poisson(mean, (2, windows, bins, count))
        # A pixel that is drawn twice fires as it was drawn last.
        last = count - 1 - np.unique((pixels[0] * width + pixels[1])[::-1], return_index=True)[1]
        yield pixels[:, last], (on - off)[..., last].transpose(2, 0, 1)
