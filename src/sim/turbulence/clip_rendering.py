"""From the plans of a clip (clip_plan.py) to the pixels of its views.

Per picture, that is a frame of a view: Zernike coefficients at the nodes of two grids, from them
the tilt of every pixel and the weights of its PSF, then tilt first and blur second (Chan 2022,
arXiv 2207.06377).  Every point spreads its light by the PSF it sees (Chimitt et al. 2023, arXiv
2303.05687); the sum is divided by what a white scene would give: flat stays flat.

On the CPU a thread renders some frames of one view at a time, a device many pictures at a time;
they differ by float32 rounding only.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.turbulence.clip_plan import TilePlan
from src.sim.turbulence.coefficient_grid import WaveSum, evaluate_waves, sum_waves
from src.sim.turbulence.engines import device as devices
from src.sim.turbulence.engines.network_numba import evaluate_psf_network
from src.sim.turbulence.engines.scatter_numba import scatter_normalised
from src.sim.turbulence.engines.warp_numba import PaddedFrames, pad_frames, warp_frames
from src.sim.turbulence.p2s import FoldedNetwork
from src.sim.turbulence.psf import convolve_halo

DEVICE_BYTES = 2 * 2**30  # held at a time on a device, about
CPU_NUMBERS = 2_000_000  # at the nodes of a view at a time, on the CPU


def render_views(
    frames: Float[Tensor, "frames height width"],
    plans: Sequence[TilePlan],
    *,
    use_cpu_engines: bool | None = None,
) -> Float[Tensor, "views frames h w"]:
    """Return every view in the plans' tiles together, on the device of `frames`.

    `use_cpu_engines`: whether by the engines of the CPU; None: where `frames` are there.
    """
    if use_cpu_engines is None:
        use_cpu_engines = frames.device.type == "cpu"
    padded = pad_frames(frames) if use_cpu_engines else None
    out, parts = _allocate_tiles(plans, frames, len(plans[0].amplitudes))
    for plan, part in zip(plans, parts, strict=True):
        _render_tile(frames, padded, plan, part)
    return out.unflatten(0, (-1, len(frames)))


def render_tilt(plans: Sequence[TilePlan], frames: int) -> Float[Tensor, "views frames xy=2 h w"]:
    """Return the displacement (x, y) in pixels in the plans' tiles, on the CPU."""
    views = len(plans[0].amplitudes) // frames
    out, parts = _allocate_tiles(plans, torch.empty(0, dtype=torch.float32), views, frames, 2)
    for plan, part in zip(plans, parts, strict=True):
        tables, reach = plan.tables.to(torch.device("cpu")), plan.fidelity.psf_size_px // 2
        sum_tilt = _make_wave_sum(tables, "tilt", 0, on_cpu=True)
        y, x = (slice(reach, reach + size) for size in plan.tile[2:])
        for view, drawn in enumerate(plan.amplitudes.cpu().split(frames)):
            part[view] = _interpolate_tilt(plan, tables, sum_tilt(drawn))[..., y, x].transpose(0, 1)
    return out


def _allocate_tiles(
    plans: Sequence[TilePlan], like: Tensor, *shape: int
) -> tuple[Tensor, list[Tensor]]:
    """Return memory for all tiles together, row by row, and each one's part of it."""
    (top, left), (y, x, height, width) = plans[0].tile[:2], plans[-1].tile
    out = like.new_empty(*shape, y + height - top, x + width - left)
    tiles = [plan.tile for plan in plans]
    return out, [out[..., y - top :, x - left :][..., :h, :w] for y, x, h, w in tiles]


def _render_tile(
    frames: Tensor, padded: PaddedFrames | None, plan: TilePlan, out: Float[Tensor, "pictures h w"]
) -> None:
    tables = plan.tables.to(frames.device)
    amplitudes = devices.copy_to_device(plan.amplitudes, frames.device)
    sum_tilt = _make_wave_sum(tables, "tilt", 0, on_cpu=padded is not None)
    sum_psf = _make_wave_sum(tables, "psf", 2, on_cpu=padded is not None)
    weigh = _make_network(tables, on_cpu=padded is not None)
    rows, columns, spectrum = (tables[f"halo_{name}"] for name in ("rows", "columns", "spectrum"))
    tables["halo"] = convolve_halo(frames, rows, columns, spectrum, plan.tile[2:])

    def render(first: int, stop: int) -> None:
        drawn = amplitudes[first:stop]
        tilt, weights = _interpolate_tilt(plan, tables, sum_tilt(drawn)), weigh(sum_psf(drawn))
        if padded is not None:
            _blur_on_cpu(padded, first % len(frames), tilt, weights, plan, tables, out[first:stop])
        else:
            out[first:stop] = _blur_on_device(frames, first, tilt, weights, plan, tables)

    with devices.full_float32():
        if padded is not None:
            run_in_threads(render, _view_parts(plan, len(amplitudes), len(frames)))
            return
        engine = devices.select_blur_engine(frames.device)
        step = max(1, DEVICE_BYTES // (4 * _numbers_per_picture(plan, engine)))
        for first in range(0, len(amplitudes), step):
            render(first, min(first + step, len(amplitudes)))


def _make_wave_sum(
    tables: dict[str, Tensor], name: str, first: int, *, on_cpu: bool
) -> Callable[[Tensor], Tensor]:
    """Return the function from amplitudes to coefficients at the nodes of the grid `name`."""
    response, rows, columns = (tables[f"{name}_{part}"] for part in ("response", "rows", "columns"))
    if on_cpu:
        return WaveSum(response, rows, columns, first)
    waves = evaluate_waves(rows, columns)
    return lambda amplitudes: sum_waves(response, amplitudes, waves)


def _make_network(tables: dict[str, Tensor], *, on_cpu: bool) -> Callable[[Tensor], Tensor]:
    """Return the function from phase at nodes to weights there, with the mean's 1 on a device."""
    network = FoldedNetwork(*(tables[name] for name in FoldedNetwork._fields))
    if not on_cpu:
        return lambda phase: network(phase.flatten(1)).unflatten(1, phase.shape[1:])
    matrices = [matrix.numpy() for matrix in network._replace(last=network.last[1:])]

    def weigh(phase: Tensor) -> Tensor:
        weights = evaluate_psf_network(phase.flatten(1).numpy(), *matrices)
        return torch.from_numpy(weights).unflatten(1, phase.shape[1:])

    return weigh


def _interpolate_tilt(
    plan: TilePlan, tables: dict[str, Tensor], nodes: Float[Tensor, "xy=2 n rows columns"]
) -> Float[Tensor, "xy=2 n h w"]:
    """Return the displacement (x, y) in pixels of every pixel, from Noll's a2 and a3 in rad."""
    if "tilt_down" in tables:
        nodes = tables["tilt_down"] @ nodes @ tables["tilt_across"]
    return nodes.mul_(2 / math.pi * plan.fidelity.lambda_over_d_px)


def _blur_on_cpu(
    padded: PaddedFrames,
    first: int,
    tilt: Float[Tensor, "xy=2 n h w"],
    weights: Float[Tensor, "rank n rows columns"],
    plan: TilePlan,
    tables: dict[str, Tensor],
    out: Float[Tensor, "n hout wout"],
) -> None:
    """Write the frames from `first` on, warped by `tilt` and spread by their PSFs, to `out`."""
    (rows, columns), nodes = plan.psf_grid, weights.numpy()
    basis = plan.psfs.quarter, np.array(plan.psfs.parity_ends)
    lattice = rows.offset_from_first_node_px, columns.offset_from_first_node_px, rows.pitch
    for index, image in enumerate(warp_frames(padded, first, tilt, rows.start, columns.start)):
        halo = tables["halo"][first + index].numpy(), plan.halo_share
        seen = scatter_normalised(image, nodes, index, *basis, *lattice, *halo)
        out[index] = torch.from_numpy(seen)


def _blur_on_device(
    frames: Float[Tensor, "frames height width"],
    first: int,
    tilt: Float[Tensor, "xy=2 n h w"],
    weights: Float[Tensor, "one_and_rank n rows columns"],
    plan: TilePlan,
    tables: dict[str, Tensor],
) -> Float[Tensor, "n hout wout"]:
    """Return the pictures from number `first` on; picture i is of frame i modulo their number."""
    if "psf_across" in tables:
        weights = weights @ tables["psf_across"]
    psfs = (tables["basis"] @ weights.flatten(1)).unflatten(1, weights.shape[1:])
    rows, columns = plan.psf_grid
    engine = devices.select_blur_engine(frames.device)
    seen = engine.warp_cubic(frames, tilt, rows.start, columns.start, first)
    return engine.scatter_normalised(seen, psfs, rows, tables["halo"], plan.halo_share, first)


def _view_parts(plan: TilePlan, pictures: int, frames: int) -> Iterator[tuple[int, int]]:
    """Yield first and last of the pictures that the CPU renders at a time, all of one view."""
    numbers = plan.fidelity.psf_rank * math.prod(axis.count for axis in plan.psf_grid)
    step = max(1, CPU_NUMBERS // numbers)
    for view in range(0, pictures, frames):
        for first in range(view, view + frames, step):
            yield first, min(first + step, view + frames)


def _numbers_per_picture(plan: TilePlan, engine: ModuleType) -> int:
    """Return how many numbers a device holds for a picture, about."""
    (rows, columns), fidelity = plan.psf_grid, plan.fidelity
    nodes, pixels = rows.node_count * columns.node_count, rows.count * columns.count
    psf = fidelity.psf_size_px**2
    sizes = [plan.tables.tensors[name].shape for name in ("first", "common", "gates", "last")]
    network = sum(map(sum, sizes)) - sizes[0][1]
    return (
        (fidelity.zernike_modes - 2 + network) * nodes
        + (1 + fidelity.psf_rank + psf) * rows.node_count * columns.count
        + (4 + engine.WARP_NUMBERS + engine.SCATTER_NUMBERS * psf) * pixels
    )


def run_in_threads(work: Callable[..., None], parts: Iterable[tuple]) -> None:
    """Call `work(*part)` for every part, each in one thread, in as many threads as torch has."""
    parts, allowed = list(parts), torch.get_num_threads()
    threads = min(allowed, len(parts))
    if threads == 1:
        for part in parts:
            work(*part)
        return
    inference = torch.is_inference_mode_enabled()  # a thread's own, as is autograd

    def work_alone(*part) -> None:
        with torch.inference_mode(inference), torch.no_grad():
            work(*part)

    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            for job in [pool.submit(work_alone, *part) for part in parts]:
                job.result()
    finally:
        torch.set_num_threads(allowed)  # of threads to come: torch lets the last call decide
