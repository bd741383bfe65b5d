"""No more than a scene needs: how finely an atmosphere is simulated, and what that costs in error.

Errors are powers, as shares of the power by which turbulence at random changes a picture (its blur
against the mean blur, tilt apart) with the spectrum 1 / f^2 of natural ones.  The tables behind
them are measured on exact PSFs by scripts/p2s_errors.py and kept beside the networks.
"""

import math
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from src.sim.turbulence.atmosphere import ALPHA_FPS, TILT_VARIANCE, Atmosphere
from src.sim.turbulence.costs import at, between, table
from src.sim.turbulence.p2s import FINE_PER_AIRY, Band, bands
from src.sim.turbulence.seeing import half_light

CONTRAST = 0.2  # rms contrast of a natural picture
UNSEEN = 0.5 / 255  # rms error that nobody needs to go below
SHARES = {"psf": 0.57, "pitch": 0.33, "kernel": 0.1}  # of the tolerance
BEYOND = 1.06  # the networks are fitted a little beyond the edge of their band
EXACT_MODES = 119  # whole orders up to n = 14, for D/r0 beyond the tables
MOST_MODES = 200
MAX_PITCH = 64
UNRELATED = 2.0  # the error of a PSF taken from a place that has nothing to do with it
TILT_ERROR = 0.35  # of the tilt's spread, per D between nodes


@dataclass(frozen=True)
class Fidelity:
    """One atmosphere in pixels, and how it is simulated.

    `blurring_d_over_r0`: of the Kolmogorov air that blurs as much (an outer scale weakens blur).
    `decay_s`: the time after which the tilt's correlation is 1 / e, of `ar1`; `spread_px` and
    `half_length_px`: see Atmosphere; `d_px`: the aperture at the object;
    `aperture_over_outer_scale` D / L0; `tilt_px`: standard deviation along one axis; `airy_px`:
    lambda / D; `blur_px`: the radius that holds half of the light of a point, tilt removed.
    `modes` Noll modes from tilt on, `network` the one that turns them into weights of `rank` basis
    functions (0: exact PSFs), `kernel` pixels across the PSF, `pitch` and `tilt_pitch` pixels
    between the nodes of the phase.  `error_psf` (modes left out, network and basis), `error_pitch`,
    `error_kernel`: shares of the random power; `error`: the rms error they make together, of a
    picture's contrast.
    """

    d_over_r0: float = 0.0
    blurring_d_over_r0: float = 0.0
    severity: str = "none"
    rytov: float = 0.0
    alpha: float = 1.0
    decay_s: float = math.inf
    spread_px: float = 0.0
    half_length_px: float = math.inf
    d_px: float = 0.0
    aperture_over_outer_scale: float = 0.0
    tilt_px: float = 0.0
    airy_px: float = 0.0
    blur_px: float = 0.0
    modes: int = 0
    network: int = 0
    rank: int = 0
    kernel: int = 1
    pitch: int = 1
    tilt_pitch: int = 1
    error_psf: float = 0.0
    error_pitch: float = 0.0
    error_kernel: float = 0.0
    error_tilt_px: float = 0.0
    error: float = 0.0


def choose(
    atmosphere: Atmosphere, width_px: int, tolerance: float, exact: bool, given: int | None = None
) -> Fidelity:
    """Return the cheapest fidelity whose errors keep within `tolerance` of the random power.

    An rms error of half a grey level of 256 is always allowed.  With `exact` PSFs there is no rank.
    The number of modes may be `given`; ValueError for one that nothing here can simulate.
    """
    seen = _seen(atmosphere, width_px)
    strength, airy = seen.blurring_d_over_r0, seen.airy_px
    power = _random_power(strength, airy)
    allowed = max(tolerance, (UNSEEN / CONTRAST) ** 2 / power)
    band = None if exact else band_for(strength)
    modes, network, rank, error_psf = _psf(strength, airy, allowed, band, given)
    reach, error_kernel = _cheapest("kernel", strength, airy, SHARES["kernel"] * allowed)
    pixel = atmosphere.object_pixel_m(width_px) / atmosphere.aperture_m
    step, error_pitch = _widest(strength, airy, allowed)
    step *= _patch(atmosphere)
    pitch = int(min(max(step / pixel, 1), MAX_PITCH))
    error_pitch = error_pitch if pitch > 1 else 0.0
    tilt_pitch, error_tilt = _tilt_pitch(pixel / _patch(atmosphere), seen, tolerance)
    return replace(
        seen,
        modes=modes,
        network=network,
        rank=rank,
        kernel=_kernel(strength, airy, reach),
        pitch=pitch,
        tilt_pitch=tilt_pitch,
        error_psf=error_psf,
        error_pitch=error_pitch,
        error_kernel=error_kernel,
        error_tilt_px=error_tilt,
        error=math.sqrt(power * (error_psf + error_pitch + error_kernel)),
    )


def mean_psf(strength: float) -> Float[Tensor, "fine fine"]:
    """Return the mean PSF at D/r0 = `strength`, tilt removed, sampled at FINE_PER_AIRY."""
    return between(table("mean"), table("strength"), strength)


def _seen(atmosphere: Atmosphere, width_px: int) -> Fidelity:
    """Return what the atmosphere is in pixels, before anything is chosen."""
    airy = atmosphere.airy_px(width_px)
    return Fidelity(
        d_over_r0=atmosphere.d_over_r0,
        blurring_d_over_r0=atmosphere.blurring_d_over_r0,
        severity=atmosphere.severity,
        rytov=atmosphere.rytov,
        alpha=atmosphere.alpha,
        decay_s=-1 / (ALPHA_FPS * math.log(atmosphere.alpha)) if 0 < atmosphere.alpha < 1 else 0.0,
        spread_px=atmosphere.spread_px(width_px),
        half_length_px=atmosphere.half_length_px(width_px),
        d_px=atmosphere.aperture_m / atmosphere.object_pixel_m(width_px),
        aperture_over_outer_scale=atmosphere.inverse_outer_scale,
        tilt_px=atmosphere.tilt_std_px(width_px),
        airy_px=airy,
        blur_px=airy * half_light(atmosphere.blurring_d_over_r0),
    )


def _patch(atmosphere: Atmosphere) -> float:
    """Return how large the patches of like phase are, over those of a constant Cn2.

    The ratio of theta0 L / r0, Kolmogorov's: an outer scale does not change small distances.
    """
    place, strength = atmosphere.path
    near = float((strength * (1 - place) ** (5 / 3)).sum())
    return (near / float((strength * place ** (5 / 3)).sum())) ** 0.6


def band_for(strength: float) -> Band | None:
    """Return the weakest band that covers D/r0 = `strength`; None beyond the last."""
    return next((band for band in bands() if strength <= BEYOND * band.edge), None)


def _kernel(strength: float, airy: float, reach: float) -> int:
    """Return the odd number of pixels that `reach` lambda / D cover, within the basis if any."""
    band = band_for(strength)
    widest = band.mean.shape[-1] / FINE_PER_AIRY / 2 if band else 6 + 0.6 * strength
    reach = reach if band else widest
    return 2 * math.floor(min(reach + 0.5 / airy, widest) * airy) + 1


def _cheapest(name: str, strength: float, airy: float, limit: float) -> tuple[float, float]:
    """Return the first entry of the table's axis within `limit`, and its error."""
    errors = at(name, strength, airy)
    within = (errors <= limit).nonzero()
    index = int(within[0]) if len(within) else len(errors) - 1
    return float(table(f"{name}_axis")[index]), float(errors[index])


def _psf(
    strength: float, airy: float, allowed: float, band: Band | None, given: int | None
) -> tuple[int, int, int, float]:
    """Return how many modes, which network and basis functions, and their error.

    Without a band PSFs are exact: network and rank are 0.  If the modes are `given`, an error is
    stated as if the rest were missing, though a network adds their mean blur.
    """
    limit = SHARES["psf"] * allowed
    most = band.networks[-1].modes if band else MOST_MODES
    if given is not None and not 2 <= given <= most:
        kind = "fitted" if band else "exact"
        raise ValueError(f"turbulence.modes must be in [2, {most}] with {kind} PSFs, got {given}")
    left = _left_out(strength, airy, given) if given else 0.0
    if band is None:
        modes, error = _cheapest("modes", strength, airy, limit)
        modes = int(modes) if strength <= BEYOND * bands()[-1].edge else EXACT_MODES
        return (given, 0, 0, left) if given else (modes, 0, 0, error)
    network, rank, error = _network(strength, airy, limit, band, given or 0)
    return given or band.networks[network].modes, network, rank, max(error, left)


def _left_out(strength: float, airy: float, modes: int) -> float:
    """Return the error of exact PSFs of the first `modes` modes; without any blur it is 1."""
    covered = int((table("modes_axis") <= modes).sum())
    return float(at("modes", strength, airy)[covered - 1]) if covered else 1.0


def _network(
    strength: float, airy: float, limit: float, band: Band, modes: int
) -> tuple[int, int, float]:
    """Return the smallest network and rank within `limit`, or the best, and their error.

    Of the networks that know `modes` modes.
    """
    number = bands().index(band)
    rows = between(table("psf")[number], table("psf_strength")[number], strength)
    errors = between(rows.movedim(-1, 0), table("airy"), airy)
    ranks = [min(int(rank), len(band.basis)) for rank in table("rank_axis")]
    fit = [n for n, network in enumerate(band.networks) if network.modes >= modes]
    some = ((n, r, float(errors[n, i])) for n in fit for i, r in enumerate(ranks))
    within = next((choice for choice in some if choice[2] <= limit), None)
    return within or (fit[-1], ranks[-1], float(errors[fit[-1], -1]))


def _widest(strength: float, airy: float, allowed: float) -> tuple[float, float]:
    """Return the widest pitch in units of D at the object whose error is allowed, and the error."""
    errors = at("pitch", strength, airy).cummax(0).values
    limit, axis = SHARES["pitch"] * allowed, table("pitch_axis")
    if limit >= UNRELATED:
        return math.inf, UNRELATED
    if limit <= errors[0]:  # the error falls at least with the first power of the pitch
        return float(axis[0] * limit / errors[0]), float(limit)
    index = min(int((errors <= limit).sum()) - 1, len(axis) - 2)
    share = (limit - errors[index]) / (errors[index + 1] - errors[index]).clamp(min=1e-9)
    share = float(share.clamp(0, 1))
    step = axis[index] * (axis[index + 1] / axis[index]) ** share
    return float(step), float(errors[index] + share * (errors[index + 1] - errors[index]))


def _tilt_pitch(pixel: float, seen: Fidelity, tolerance: float) -> tuple[int, float]:
    """Return the widest pitch within 0.03 px or a tenth of the tolerance's rms, and its error.

    `pixel` in units of D at the object.  Cubic interpolation between nodes S D apart leaves an rms
    error of 0.35 S of the spread that Kolmogorov's tilt has, measured on 30,000 waves for a
    constant Cn2; an outer scale takes away long waves only, so the error stays.
    """
    allowed = max(0.03, 0.1 * math.sqrt(tolerance) * seen.tilt_px)
    kolmogorov = 2 / math.pi * seen.airy_px * math.sqrt(TILT_VARIANCE) * seen.d_over_r0 ** (5 / 6)
    error = TILT_ERROR * pixel * kolmogorov
    pitch = int(min(max(allowed / error, 1), MAX_PITCH))
    return pitch, error * pitch if pitch > 1 else 0.0


def _random_power(strength: float, airy: float) -> float:
    """Return the power of the random change of a picture of unit contrast; grows as d^(5/3)."""
    weak = min(strength / float(table("strength")[0]), 1.0) ** (5 / 3)
    return max(float(at("power", strength, airy)) * weak, 1e-30)
