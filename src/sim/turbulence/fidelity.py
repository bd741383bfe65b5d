"""No more than a scene needs: how finely an atmosphere is simulated, and what that costs in error.

Errors are powers, as shares of the power by which turbulence at random changes a picture (its blur
against the mean blur, tilt apart) with the spectrum 1 / f^2 of natural ones.  The tables behind
them are measured on exact PSFs by scripts/p2s_errors.py and kept beside the networks.
"""

import math
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from src.sim.turbulence import choice
from src.sim.turbulence.atmosphere import ALPHA_FPS, TILT_VARIANCE, Atmosphere
from src.sim.turbulence.choice import MAX_PITCH
from src.sim.turbulence.grids import at, between, table
from src.sim.turbulence.p2s import band_for
from src.sim.turbulence.seeing import half_light

CONTRAST = 0.2  # rms contrast of a natural picture
UNSEEN = 0.5 / 255  # rms error that nobody needs to go below
TILT_ERROR = 0.35  # of the tilt's spread, per D between nodes
TILT_SHARE = 0.06  # of the spread, that interpolating the tilt may err by


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
    pixel = atmosphere.object_pixel_m(width_px) / atmosphere.aperture_m / _patch(atmosphere)
    band = None if exact else band_for(strength)
    chosen = (
        choice.fitted(band, strength, airy, pixel, allowed, given)
        if band
        else choice.exact(strength, airy, pixel, allowed, given)
    )
    tilt_pitch, error_tilt = _tilt_pitch(pixel, seen)
    return replace(
        seen,
        **chosen._asdict(),
        tilt_pitch=tilt_pitch,
        error_tilt_px=error_tilt,
        error=math.sqrt(power * (chosen.error_psf + chosen.error_pitch + chosen.error_kernel)),
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


def _tilt_pitch(pixel: float, seen: Fidelity) -> tuple[int, float]:
    """Return the widest pitch within 0.03 px or TILT_SHARE of the spread, and its error.

    `pixel` in units of D at the object.  Cubic interpolation between nodes S D apart leaves an rms
    error of 0.35 S of the spread that Kolmogorov's tilt has, measured on 30,000 waves for a
    constant Cn2; an outer scale takes away long waves only, so the error stays.
    """
    allowed = max(0.03, TILT_SHARE * seen.tilt_px)
    kolmogorov = 2 / math.pi * seen.airy_px * math.sqrt(TILT_VARIANCE) * seen.d_over_r0 ** (5 / 6)
    error = TILT_ERROR * pixel * kolmogorov
    pitch = int(min(max(allowed / error, 1), MAX_PITCH))
    return pitch, error * pitch if pitch > 1 else 0.0


def _random_power(strength: float, airy: float) -> float:
    """Return the power of the random change of a picture of unit contrast; grows as d^(5/3)."""
    weak = min(strength / float(table("strength")[0]), 1.0) ** (5 / 3)
    return max(float(at("power", strength, airy)) * weak, 1e-30)
