"""What the pixels of a clip need: small tables made on the CPU, by another process if need be."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from src.sim.turbulence.coefficient_grid import Grid, GridAxis, zero_weak_responses
from src.sim.turbulence.contract import Crop
from src.sim.turbulence.engines.device import copy_to_device
from src.sim.turbulence.fidelity import Fidelity
from src.sim.turbulence.p2s import FittedPSFs
from src.sim.turbulence.plane_waves import PlaneWaves
from src.sim.turbulence.psf import PSFHalo

ALIGNMENT = 16  # bytes
Places = Mapping[str, tuple[slice, torch.dtype, torch.Size]]


class PackedTensors:
    """Tensors of the CPU by name; one copy takes all to a device or, pickled, to a process."""

    def __init__(self, tensors: Mapping[str, Tensor]):
        self.tensors = dict(tensors)

    def to(self, device: torch.device) -> dict[str, Tensor]:
        """Return the tensors on `device`."""
        if device.type == "cpu":
            return dict(self.tensors)
        memory, places = self.packed
        return _unpack(copy_to_device(memory, device), places)

    @cached_property
    def packed(self) -> tuple[Tensor, Places]:
        """The tensors in one piece of memory, and their places there."""
        places, end = {}, 0
        for name, part in self.tensors.items():
            places[name] = slice(end, end + part.nbytes), part.dtype, part.shape
            end += -(-part.nbytes // ALIGNMENT) * ALIGNMENT
        memory = torch.zeros(end, dtype=torch.uint8)
        for name, part in self.tensors.items():
            memory[places[name][0]].copy_(part.contiguous().flatten().view(torch.uint8))
        return memory, places

    def __getstate__(self) -> tuple[Tensor, Places]:
        return self.packed

    def __setstate__(self, state: tuple[Tensor, Places]) -> None:
        self.tensors, self.packed = _unpack(*state), state


def _unpack(memory: Tensor, places: Places) -> dict[str, Tensor]:
    return {
        name: memory[place].view(dtype).view(shape)
        for name, (place, dtype, shape) in places.items()
    }


@dataclass(frozen=True)
class TilePlan:
    """What the pixels of one tile of a clip need; `halo_share`: see PSFHalo."""

    tile: Crop
    amplitudes: Complex[Tensor, "pictures waves"]  # complex64, on any device
    tables: PackedTensors
    psf_grid: Grid
    fidelity: Fidelity
    psfs: FittedPSFs
    halo_share: float

    def select_frames(self, first: int, stop: int, frames: int) -> "TilePlan":
        """Return the plan of frames first .. stop - 1 of the clip's `frames`."""
        by_view = self.amplitudes.unflatten(0, (-1, frames))
        return replace(self, amplitudes=by_view[:, first:stop].flatten(0, 1))


def plan_tile(
    tile: Crop,
    frame_size: tuple[int, int],
    amplitudes: Complex[Tensor, "views frames waves"],
    waves: PlaneWaves,
    fidelity: Fidelity,
    psfs: FittedPSFs,
    halo: PSFHalo,
) -> TilePlan:
    """Return the plan of a tile of frames of `frame_size` (h, w)."""
    reach, (top, left, height, width) = fidelity.psf_size_px // 2, tile
    rows, columns = (top - reach, height + 2 * reach), (left - reach, width + 2 * reach)
    pitches = (fidelity.tilt_grid_pitch_px, 3), (fidelity.psf_grid_pitch_px, 1)
    tilt_grid, psf_grid = ((GridAxis(*rows, *one), GridAxis(*columns, *one)) for one in pitches)
    response = torch.view_as_complex(waves.response).to(torch.complex64)
    tables = _wave_tables("tilt", tilt_grid, waves, frame_size)
    tables |= _wave_tables("psf", psf_grid, waves, frame_size)
    tables["tilt_response"] = tables["tilt_response"] * zero_weak_responses(response[:2], 0)
    tables["psf_response"] = tables["psf_response"] * zero_weak_responses(response[2:], 2)
    if tilt_grid[0].pitch > 1:
        tables["tilt_down"] = tilt_grid[0].interpolation_matrix()
        tables["tilt_across"] = tilt_grid[1].interpolation_matrix().T
    if psf_grid[1].pitch > 1:
        tables["psf_across"] = psf_grid[1].interpolation_matrix().T
    names = "halo_rows", "halo_columns", "halo_spectrum"
    tables |= zip(names, halo.sources_and_spectrum(frame_size, tile), strict=True)
    strength = fidelity.blur_equivalent_d_over_r0
    network = psfs.network.merge_into_few_matrices(len(response) - 2, strength)
    tables |= {"basis": psfs.basis.flatten(1).T} | network._asdict()
    packed, drawn = PackedTensors(tables), amplitudes.flatten(0, 1)
    return TilePlan(tile, drawn, packed, psf_grid, fidelity, psfs, halo.share)


def _wave_tables(
    name: str, grid: Grid, waves: PlaneWaves, frame_size: tuple[int, int]
) -> dict[str, Tensor]:
    """Return each wave, conjugated, along the rows of a grid and along its columns from the middle
    one on, and its factor at the middle column; the axis of the camera is the frame's middle.
    """
    (rows, columns), (height, width) = (axis.node_pixels for axis in grid), frame_size
    middle = (columns[0] + columns[-1]) / 2
    along_x, along_y = waves.frequency_per_px.double().split(1, 1)
    return {
        f"{name}_response": _phasor(along_x[:, 0] * (middle - (width - 1) / 2).double()),
        f"{name}_rows": _phasor(-along_y * (rows - (height - 1) / 2)),
        f"{name}_columns": _phasor(-along_x * (columns - middle)),
    }


def _phasor(turns: Float[Tensor, "*n"]) -> Complex[Tensor, "*n"]:
    """Return exp(2 pi i turns), complex64; whole turns are taken off in float64."""
    angle = (2 * torch.pi * (turns - turns.round())).float()
    return torch.polar(torch.ones_like(angle), angle)
