"""What turbulence does to a picture: tilt first, then blur, as light is scattered.

Chan 2022 (arXiv 2207.06377): tilt, then blur; Chimitt et al. 2023 (arXiv 2303.05687): every point
spreads its light by the PSF it sees.  The sum is divided by what a white scene would give, as the
radiance of an endless uniform scene survives a medium that only bends light: flat stays flat.
Outside the frame the scene is its reflection.  On the CPU the two steps are compiled
(src/sim/engines), elsewhere they are the torch expressions below; one pixel more or less of float32
rounding is all they differ by.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import torch
from jaxtyping import Float, Int
from torch import Tensor

from src.sim.turbulence.engines import scatter as scatter_engine
from src.sim.turbulence.engines import warp as warp_engine
from src.sim.turbulence.lattice import Lattice


def degrade(
    frames: Float[Tensor, "frames height width"],
    seen: Iterable[tuple[Tensor, Tensor]],
    rows: Lattice,
    columns: Lattice,
    halo: Float[Tensor, "frames hout wout"],
    share: float,
) -> Float[Tensor, "views frames hout wout"]:
    """Warp the frames by each view's tilt, then scatter them by its PSFs and add their `halo`.

    `seen`: of every view, its tilt in pixels (frames, 2, h, w) over the window of `rows` and
    `columns`, and the PSFs (frames, rows, k, k, columns) on their nodes.  The result lacks k // 2
    pixels on each side.  The halo of a white scene would be `share`.
    """
    if frames.device.type != "cpu":
        return torch.stack([_eager(frames, *both, rows, columns, halo, share) for both in seen])

    def one(image: Tensor, tilt: Tensor, kernel: Tensor, halo: Tensor) -> Tensor:
        tilted = warp_engine.warp(image.numpy(), tilt.numpy(), rows.start, columns.start)
        if kernel.shape[1] == 1 and share == 0:
            return torch.from_numpy(tilted)
        nodes = (kernel.numpy(), rows.offset, columns.offset, rows.pitch)
        return torch.from_numpy(scatter_engine.scatter(tilted, *nodes, halo.numpy(), share))

    # All is drawn before any thread starts: torch's own threads would wait for cores in use.
    work = [
        each for tilt, kernels in seen for each in zip(frames, tilt, kernels, halo, strict=True)
    ]
    threads = min(torch.get_num_threads(), len(work))
    if threads == 1:
        light = [one(*each) for each in work]
    else:
        with ThreadPoolExecutor(threads) as pool:
            light = [job.result() for job in [pool.submit(one, *each) for each in work]]
    return torch.stack(light).unflatten(0, (-1, len(frames)))


def _eager(
    frames: Tensor,
    tilt: Tensor,
    kernels: Tensor,
    rows: Lattice,
    columns: Lattice,
    halo: Tensor,
    share: float,
) -> Tensor:
    tilted = warp(frames, tilt, rows.start, columns.start)
    both = (rows.weights().to(tilt), columns.weights().to(tilt))
    return scatter(tilted, kernels, *both, halo, share)


def warp(
    frames: Float[Tensor, "frames height width"],
    tilt: Float[Tensor, "frames 2 h w"],
    top: int,
    left: int,
) -> Float[Tensor, "frames h w"]:
    """Return frame(x - tilt(x)) over the window whose first pixel is (`top`, `left`).

    Keys' cubic (a = -1/2), held within each frame's own range.
    """
    height, width = frames.shape[-2:]
    rows = torch.arange(tilt.shape[-2], device=tilt.device)[:, None] + top
    columns = torch.arange(tilt.shape[-1], device=tilt.device) + left
    x, y = columns - tilt[:, 0], rows - tilt[:, 1]
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
    kernels: Float[Tensor, "frames rows k k columns"],
    vertical: Float[Tensor, "h rows"],
    horizontal: Float[Tensor, "w columns"],
    halo: Float[Tensor, "frames hout wout"],
    share: float,
) -> Float[Tensor, "frames hout wout"]:
    """Spread every pixel's light by the PSF there, over what a white scene would give.

    `vertical` and `horizontal` interpolate the PSFs between the nodes; `halo` is the light from
    beyond them, `share` what it would be of a white scene.
    """
    size = kernels.shape[2]
    height, width = halo.shape[-2:]
    light, white = halo.clone(), torch.full_like(halo, share)
    for v in range(size):
        rows = slice(size - 1 - v, size - 1 - v + height)
        nodes = kernels[:, :, v].transpose(1, 2)
        for u in range(size):
            columns = slice(size - 1 - u, size - 1 - u + width)
            share = vertical[rows] @ nodes[:, u] @ horizontal[columns].T
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
