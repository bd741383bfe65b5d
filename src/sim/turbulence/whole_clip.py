"""All views and frames of a clip at once: how a device simulates, where every launch costs.

A plan holds what pixels need, small tables made on the CPU, by another process if need be.  The
rest is some fifty launches: the phase at all nodes of all pictures is one product of matrices, the
network from phase to weights of PSFs thirteen operators, the PSFs another product, warp and scatter
a kernel each.  A view's numbers are those that a CPU computes for it apart (operator.py) but for
float32 rounding, which may depend on its company.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from src.sim.turbulence import blur
from src.sim.turbulence.engines import blur_engine
from src.sim.turbulence.engines.device import Packed, full_float32, moved
from src.sim.turbulence.fidelity import Fidelity
from src.sim.turbulence.halo import Halo, halo_light
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.model import Crop
from src.sim.turbulence.p2s import Spots
from src.sim.turbulence.p2s_network import Merged
from src.sim.turbulence.phase import Waves
from src.sim.turbulence.psf import exact_spots
from src.sim.turbulence.wave_field import orders

MEMORY = 2 * 2**30  # bytes held at a time, about
Lattices = tuple[Lattice, Lattice]  # rows and columns


@dataclass(frozen=True)
class Plan:
    """What the pixels of one tile of a clip need.

    `amplitudes` (views * frames, waves), complex64, anywhere; `tables`, those of `plan`; the
    lattices of the tilt and of the modes that blur; `modes`, how many blur; `share`: see Halo.
    """

    tile: Crop
    amplitudes: Tensor
    tables: Packed
    tilt: Lattices
    rest: Lattices
    fidelity: Fidelity
    modes: int
    share: float


def plan(
    tile: Crop,
    amplitudes: Complex[Tensor, "views frames waves"],
    waves: Waves,
    *,
    frame: tuple[int, int],
    tilt: Lattices,
    rest: Lattices,
    fidelity: Fidelity,
    spots: Spots | None,
    halo: Halo,
    tilt_px: float,
) -> Plan:
    """Return the plan of a tile of frames of the size `frame`; `tilt_px`: pixels a radian."""
    response = torch.view_as_complex(waves.response).to(torch.complex64)
    sides = [side.pixels for side in (*tilt, *rest)]
    middle = [(size - 1) / 2 for size in frame] * 2
    tables = {
        "tilt": tilt_px * _heard(response[:2], 0),
        "rest": _heard(response[2:], 2),
        "frequency": waves.frequency,
        "places": torch.cat([side - half for side, half in zip(sides, middle, strict=True)]),
        "axes": torch.cat([torch.full_like(side, 1 - k % 2) for k, side in enumerate(sides)]),
    }
    if tilt[0].pitch > 1:
        tables |= {"tilt_down": tilt[0].weights(), "tilt_across": tilt[1].weights().T}
    if rest[1].pitch > 1:
        tables["rest_across"] = rest[1].weights().T
    if halo.share > 0:
        tables |= zip(("halo_rows", "halo_columns", "halo"), halo.tables(frame, *tile), strict=True)
    modes = len(response) - 2
    if spots is not None:
        tables |= {"shapes": spots.shapes.flatten(1).T} | spots.merged(modes)._asdict()
    drawn = amplitudes.flatten(0, 1)
    return Plan(tile, drawn, Packed(tables), tilt, rest, fidelity, modes, halo.share)


def degrade(
    frames: Float[Tensor, "frames height width"], plans: Sequence[Plan]
) -> Float[Tensor, "views frames h w"]:
    """Return what every view sees in the plans' tiles together, on the device of `frames`."""
    return _together([_tile(frames, plan) for plan in plans], plans)


def tilt(plans: Sequence[Plan], frames: int) -> Float[Tensor, "views frames 2 h w"]:
    """Return the displacement (x, y) in pixels there, on the CPU."""
    parts = []
    for plan in plans:
        tables, reach = plan.tables.on(torch.device("cpu")), plan.fidelity.kernel // 2
        found = _tilt(tables, plan.amplitudes.cpu(), waves_at(*_turns(tables, plan)[:2]))
        y, x = (slice(reach, reach + size) for size in plan.tile[2:])
        parts.append(found[..., y, x].transpose(0, 1).unflatten(0, (-1, frames)))
    return _together(parts, plans)


def _together(parts: Sequence[Tensor], plans: Sequence[Plan]) -> Tensor:
    """Return what lies in the plans' tiles as one, the last two axes being rows and columns."""
    if len(parts) == 1:
        return parts[0]
    top, left = (min(plan.tile[axis] for plan in plans) for axis in (0, 1))
    ends = [max(plan.tile[axis] + plan.tile[axis + 2] for plan in plans) for axis in (0, 1)]
    out = parts[0].new_empty(*parts[0].shape[:-2], ends[0] - top, ends[1] - left)
    for part, plan in zip(parts, plans, strict=True):
        y, x, height, width = plan.tile
        out[..., y - top : y - top + height, x - left : x - left + width] = part
    return out


def _tile(frames: Tensor, plan: Plan) -> Float[Tensor, "views frames h w"]:
    tables, drawn = plan.tables.on(frames.device), moved(plan.amplitudes, frames.device)
    turns = _turns(tables, plan)
    tables |= {"tilting": waves_at(*turns[:2]), "blurring": waves_at(*turns[2:])}
    tables["light"] = _halo(frames, plan, tables)
    with full_float32():
        parts = [_pictures(frames, plan, tables, *part) for part in _parts(drawn, plan)]
    return (parts[0] if len(parts) == 1 else torch.cat(parts)).unflatten(0, (-1, len(frames)))


def _pictures(
    frames: Tensor, plan: Plan, tables: dict[str, Tensor], first: int, drawn: Tensor
) -> Float[Tensor, "n h w"]:
    """Return the pictures whose amplitudes are `drawn`, number `first` and those after it."""
    tilt = _tilt(tables, drawn, tables["tilting"])
    phase = coefficients(tables["rest"], drawn, tables["blurring"])
    if "shapes" in tables:
        network = Merged(*(tables[name] for name in Merged._fields))
        lines = network(phase.flatten(1)).unflatten(1, phase.shape[1:])
    else:
        lines = exact_spots(phase, plan.fidelity.airy_px, plan.fidelity.kernel)
    if "rest_across" in tables:
        lines = lines @ tables["rest_across"]
    if "shapes" in tables:
        lines = (tables["shapes"] @ lines.flatten(1)).unflatten(1, lines.shape[1:])
    around = (*plan.rest, tables["light"], plan.share)
    return blur.at_once(frames, tilt, lines, *around, first=first)


def coefficients(
    response: Complex[Tensor, "modes waves"],
    amplitudes: Complex[Tensor, "n waves"],
    waves: Float[Tensor, "twice_the_waves rows columns"],
) -> Float[Tensor, "modes n rows columns"]:
    """Return the Noll coefficients at the nodes that `waves` are known at: wave_field.Field's."""
    parts = torch.view_as_real(response[:, None] * amplitudes).flatten(2).flatten(0, 1)
    found = parts @ waves.flatten(1)
    return found.view(len(response), len(amplitudes), *waves.shape[1:])


def waves_at(
    down: Complex[Tensor, "waves rows"], across: Complex[Tensor, "waves columns"]
) -> Float[Tensor, "twice_the_waves rows columns"]:
    """Return waves at all nodes, from their conjugates along rows and columns: the real part of
    each, then the negative imaginary part.
    """
    waves = torch.view_as_real(down[:, :, None] * across[:, None])
    return waves.permute(0, 3, 1, 2).flatten(0, 1)


def _tilt(tables: dict[str, Tensor], drawn: Tensor, waves: Tensor) -> Float[Tensor, "2 n h w"]:
    """Return the displacement (x, y) of pictures in pixels, from the waves at the tilt's nodes."""
    tilt = coefficients(tables["tilt"], drawn, waves)
    return tables["tilt_down"] @ tilt @ tables["tilt_across"] if "tilt_down" in tables else tilt


def _turns(tables: dict[str, Tensor], plan: Plan) -> Sequence[Complex[Tensor, "waves _"]]:
    """Return exp(-2 pi i f x) of every wave at the rows and columns of both lattices."""
    turns = tables["frequency"][:, tables["axes"]] * tables["places"]
    angle = (-2 * torch.pi * (turns - turns.round())).float()  # whole turns go in float64
    sides = [side.nodes for side in (*plan.tilt, *plan.rest)]
    return torch.polar(torch.ones_like(angle), angle).split(sides, 1)


def _heard(response: Complex[Tensor, "modes waves"], first: int) -> Complex[Tensor, "modes waves"]:
    """Return the responses to the waves that each order of modes sees, 0 to the others."""
    heard = torch.zeros_like(response)
    for own, seen in orders(response, first):
        heard[own, seen] = response[own, seen]
    return heard


def _halo(frames: Tensor, plan: Plan, tables: dict[str, Tensor]) -> Float[Tensor, "frames h w"]:
    size = plan.tile[2:]
    if "halo" not in tables:
        return frames.new_zeros(len(frames), *size)
    return halo_light(frames, tables["halo_rows"], tables["halo_columns"], tables["halo"], *size)


def _parts(drawn: Tensor, plan: Plan) -> Iterator[tuple[int, Tensor]]:
    """Yield the number of a picture, and the amplitudes from it on that MEMORY has room for."""
    step = max(1, MEMORY // (4 * _numbers(plan, blur_engine.on(drawn.device))))
    for first in range(0, len(drawn), step):
        yield first, drawn[first : first + step]


def _numbers(plan: Plan, engine: ModuleType) -> int:
    """Return how many numbers a picture takes, about."""
    rows, columns = plan.rest
    nodes, pixels = rows.nodes * columns.nodes, rows.count * columns.count
    lined, psf = rows.nodes * columns.count, plan.fidelity.kernel**2
    held = plan.modes * nodes + psf * lined + (4 + engine.WARP + engine.SCATTER * psf) * pixels
    if plan.fidelity.rank == 0:
        return held + psf * nodes
    sizes = [plan.tables.places[name][2] for name in ("first", "common", "gates", "last")]
    network = sum(map(sum, sizes)) - sizes[0][1]
    return held + network * nodes + (1 + plan.fidelity.rank) * lined
