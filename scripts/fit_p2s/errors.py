"""What each simplification of the blur costs in a natural picture, measured on exact PSFs.

All in the metric of src/sim/turbulence/fidelity.py; part of `python -m scripts.fit_p2s`.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from scripts.fit_p2s.exact_psf import fraunhofer_psf, noll_covariance
from src.sim.turbulence.atmosphere import TILT_VARIANCE, Atmosphere
from src.sim.turbulence.p2s import PSFBand, basis_parities
from src.sim.turbulence.plane_waves import draw_plane_waves
from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D

STRENGTHS = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 7.0, 10.0)
AIRY = (0.25, 0.5, 1.0, 2.0)
MODES = (5, 9, 14, 20, 27, 35, 44, 54, 65, 77)
PITCHES = (0.025, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)  # of D, at the object
RANKS = (4, 8, 12, 16, 20, 24, 32, 40, 48)
# Half the kernel, lambda / D.
REACHES = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 8.5)  # fmt: skip
TILTS = 200  # random tilts that the halo is not moved by
ALL_MODES = 119
FINE, GRID = 47, 96  # samples of a PSF, and of its transform
SPATIAL_WAVES = 256
PLACES = 4  # strengths in a band
CLIPS, CELLS = 30, 900  # waves, and places where errors are measured


def picture_power(count: int) -> Tensor:
    """Return the power spectrum 1 / f^2 of a natural picture on a `count` x `count` grid."""
    f = torch.fft.fftfreq(count, dtype=torch.float64)
    return 1 / (f[:, None].square() + f.square()).clamp(min=1 / 128**2)


def picture_metric(fine: int) -> Tensor:
    """Return the quadratic form (fine^2, fine^2) of a PSF's error in a natural picture."""
    count = 2 * fine
    correlation = torch.fft.ifft2(picture_power(count)).real
    lag = (torch.arange(fine)[:, None] - torch.arange(fine)) % count
    return correlation[lag[:, None, :, None], lag[None, :, None, :]].reshape(fine**2, fine**2)


def measure_error_tables(bands: Sequence[PSFBand]) -> dict[str, Tensor]:
    """Return the tables of `bands`: power and shares per strength and lambda / D in pixels."""
    torch.manual_seed(0)
    rows = [_row(strength) for strength in STRENGTHS]
    tables = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
    axes = {"strength": STRENGTHS, "airy": AIRY, "modes_axis": MODES, "pitch_axis": PITCHES}
    tables |= {name: torch.tensor(values) for name, values in axes.items()}
    tables |= {"rank_axis": torch.tensor(RANKS), "kernel_axis": torch.tensor(REACHES)}
    tables |= _networks(bands)
    return {f"errors.{name}": value.float().contiguous() for name, value in tables.items()}


def _row(strength: float) -> dict[str, Tensor]:
    phase = draw_phase(600, strength)
    full = exact_psfs(phase)
    power = _power(full - full.mean(0))
    modes = [_power(exact_psfs(phase[:, :count]) - full) / power for count in MODES]
    mean = symmetrise_psf(full.mean(0))
    kernel = [_kernel_error(full, mean, reach, strength) / power for reach in REACHES]
    return {
        "power": power,
        "modes": torch.stack(modes),
        "pitch": _pitch_error(strength) / power,
        "kernel": torch.stack(kernel),
        "half_light": _half_light(full.mean(0)),
        "mean": mean,
    }


def draw_phase(count: int, d_over_r0: float | Tensor) -> Tensor:
    """Return Noll 2..ALL_MODES + 1 (count, modes) in rad, no tilt; `d_over_r0`: or (count, 1)."""
    mix = torch.linalg.cholesky(noll_covariance(ALL_MODES)).float()
    phase = torch.randn(count, ALL_MODES) @ mix.T * d_over_r0 ** (5 / 6)
    phase[:, :2] = 0
    return phase


def exact_psfs(phase: Tensor, fine: int = FINE) -> Tensor:
    """Return the exact PSFs (n, fine, fine), sampled as the basis is."""
    pupil = fine - 3  # aliases fall outside the window by their own width
    return fraunhofer_psf(
        phase, lambda_over_d_px=SAMPLES_PER_LAMBDA_OVER_D, size=fine, pupil=pupil, points=1
    )


def _spectrum(errors: Tensor) -> Tensor:
    """Return the transforms (n, GRID^2) of PSF errors (n, fine, fine)."""
    return torch.fft.fft2(errors, s=(GRID, GRID)).flatten(1)


def _seen() -> Tensor:
    """Return how much each entry of a spectrum counts in a picture (airy, GRID^2), per AIRY."""
    f = torch.fft.fftfreq(GRID, dtype=torch.float64)
    out = []
    for airy in AIRY:
        step = SAMPLES_PER_LAMBDA_OVER_D / airy  # samples a pixel
        seen = ((f.abs() * step)[:, None] <= 0.5) & (f.abs() * step <= 0.5)
        picture = picture_power(GRID) * seen
        picture[0, 0] = 0
        box = torch.sinc(f * step).square()
        out.append((picture * box[:, None] * box / picture.sum()).flatten())
    return torch.stack(out)


def _power(error: Tensor) -> Tensor:
    """Return the mean power that PSF errors (n, fine, fine) make in a picture, per AIRY."""
    parts = error.split(100)  # that stay in the cache
    total = sum(_spectrum(part).abs().square().sum(0) for part in parts)
    return _seen() @ total.double() / len(error)


def _places(strength: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return phases at CELLS places (cells, modes) and at the four nodes about each, for every
    pitch (pitches, cells, 4, modes), and the nodes' weights in linear interpolation (cells, 4).
    """
    path = Atmosphere(0.1, 1.0, 1000.0, 0.1, 525e-9, 1e-14, 0.0).with_d_over_r0(strength)
    at, around, shares = [], [], []
    for clip in range(CLIPS):
        waves = draw_plane_waves(
            path, 1000 + clip, modes=ALL_MODES, waves=SPATIAL_WAVES, width_px=1
        )
        random = torch.randn(SPATIAL_WAVES, dtype=torch.complex128) * math.sqrt(2)
        response = torch.view_as_complex(waves.response) * random
        place = 100 * torch.rand(CELLS // CLIPS, 2, dtype=torch.float64)
        t = torch.rand(CELLS // CLIPS, 1, 2, dtype=torch.float64)
        corners = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=torch.float64) - t
        nodes = place[:, None] + torch.tensor(PITCHES).view(-1, 1, 1, 1) * corners
        at.append(_phase(response, waves.frequency_per_px, place))
        around.append(_phase(response, waves.frequency_per_px, nodes))
        shares.append((1 - corners.abs()).prod(-1))
    return torch.cat(at), torch.cat(around, 1), torch.cat(shares).float()


def _phase(response: Tensor, frequency: Tensor, places: Tensor) -> Tensor:
    """Return the modes (..., modes) at `places` (..., 2), without tilt."""
    wave = torch.exp(2j * math.pi * (places @ frequency.T))
    phase = (wave @ response.T).real.float()
    phase[..., :2] = 0
    return phase


def _pitch_error(strength: float) -> Tensor:
    """Return the power of linear interpolation of exact PSFs between nodes, per pitch."""
    place, nodes, shares = _places(strength)
    truth = exact_psfs(place)
    found = (_interpolated(exact_psfs(corners.flatten(0, 1)), shares) for corners in nodes)
    return torch.stack([_power(psfs - truth) for psfs in found])


def _interpolated(nodes: Tensor, shares: Tensor) -> Tensor:
    """Return what nodes (cells * 4, ...) are at the places between them (cells, ...)."""
    return torch.einsum("ck,ck...->c...", shares, nodes.unflatten(0, (-1, 4)))


def _networks(bands: Sequence[PSFBand]) -> dict[str, Tensor]:
    """Return what basis, networks and nodes far apart leave of the random power.

    Bands, strengths from where each band begins to its edge, networks, pitches (the first is 0),
    ranks, AIRY.
    """
    edges = [band.max_d_over_r0 for band in bands]
    starts = [STRENGTHS[0], *edges[:-1]]
    axes = [
        [start * (edge / start) ** (step / (PLACES - 1)) for step in range(PLACES)]
        for start, edge in zip(starts, edges, strict=True)
    ]
    rows = [
        torch.stack([_psf_errors(band, strength) for strength in axis])
        for band, axis in zip(bands, axes, strict=True)
    ]
    return {"psf": torch.stack(rows), "psf_strength": torch.tensor(axes)}


def _psf_errors(band: PSFBand, strength: float) -> Tensor:
    """Return the power per network, pitch, rank and AIRY.

    What a pixel gets is the network's PSF interpolated between its nodes, against the exact one.
    """
    place, nodes, shares = _places(strength)
    psfs = exact_psfs(place, band.mean.shape[-1]) - band.mean
    random = _power(psfs - psfs.mean(0)).float()
    order = basis_parities(band.basis).argsort(stable=True)
    truth, shapes, seen = _spectrum(psfs), _spectrum(band.basis[order]), _seen().float()
    power = seen @ truth.abs().square().T  # (airy, cells)
    with_truth = torch.einsum("af,cf,rf->acr", seen, truth, shapes.conj()).real
    among = torch.einsum("af,qf,rf->aqr", seen, shapes, shapes.conj()).real
    out = []
    for network in band.networks:
        merged = network.merge_into_few_matrices(network.modes - 2, strength)
        found = [merged(place[:, 2:].T)[1:].T]
        for corners in nodes:
            found.append(_interpolated(merged(corners.flatten(0, 1)[:, 2:].T)[1:].T, shares))
        for weights in found:
            for rank in RANKS:
                w = weights * (order < rank)
                left = power - 2 * (with_truth * w).sum(-1)
                left = left + torch.einsum("cq,aqr,cr->ac", w, among, w)
                out.append(left.mean(1) / random)
    return torch.stack(out).unflatten(0, (len(band.networks), 1 + len(PITCHES), len(RANKS)))


def symmetrise_psf(psf: Tensor) -> Tensor:
    """Return the mean of a PSF (fine, fine) over the symmetries of the square."""
    four = torch.stack([psf.rot90(turn) for turn in range(4)]).mean(0)
    return (four + four.T) / 2


def _kernel_error(full: Tensor, mean: Tensor, reach: float, strength: float) -> Tensor:
    """Return the power of PSFs that are the mean beyond `reach` lambda / D off the axes.

    Of that and of the mean, the halo, not being moved by the tilt of a pixel.
    """
    inside = (torch.arange(FINE) - FINE // 2).abs() <= reach * SAMPLES_PER_LAMBDA_OVER_D
    inside = inside & inside[:, None]
    cut = torch.where(inside, full, mean)
    random = _power(cut / cut.sum((1, 2), keepdim=True) - full)
    spread = (
        2 / math.pi * math.sqrt(TILT_VARIANCE) * strength ** (5 / 6) * SAMPLES_PER_LAMBDA_OVER_D
    )
    tilt = spread * torch.randn(TILTS, 2, generator=torch.Generator().manual_seed(1))
    return random + _power(_moved(mean.masked_fill(inside, 0), tilt))


def _moved(psf: Tensor, tilt: Tensor) -> Tensor:
    """Return by how much PSFs moved by `tilt` (n, 2) samples differ from `psf` (fine, fine)."""
    f = torch.fft.fftfreq(GRID)
    turn = tilt[:, :1, None] * f + tilt[:, 1:, None] * f[:, None]
    spectrum = torch.fft.fft2(psf, s=(GRID, GRID))
    return torch.fft.ifft2(spectrum * (torch.exp(-2j * math.pi * turn) - 1)).real


def _half_light(psf: Tensor) -> Tensor:
    """Return the radius, in lambda / D, that holds half of the light of a PSF (fine, fine)."""
    axis = (torch.arange(FINE) - FINE // 2) / SAMPLES_PER_LAMBDA_OVER_D
    radius = (axis[:, None].square() + axis.square()).sqrt().flatten()
    order = radius.argsort()
    inside = psf.flatten()[order].cumsum(0)
    at = int((inside < 0.5).sum())
    share = (0.5 - inside[at - 1]) / (inside[at] - inside[at - 1])
    return radius[order][at - 1] + share * (radius[order][at] - radius[order][at - 1])
