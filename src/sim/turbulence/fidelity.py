"""No more than a scene needs: how finely an atmosphere is simulated, and what that costs in error.

Errors are powers, as shares of the power by which turbulence at random changes a picture (its blur
against the mean blur, tilt apart) with the spectrum 1 / f^2 of natural ones.  The tables behind
them are measured on exact PSFs by scripts/p2s_errors.py and kept beside the networks.
"""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from src.sim.turbulence.atmosphere import AR1_FPS, TILT_VARIANCE, Atmosphere
from src.sim.turbulence.outer_scale import half_light_radius
from src.sim.turbulence.p2s import find_psf_band
from src.sim.turbulence.psf_settings import (
    MAX_PITCH,
    choose_psf_settings,
    error_table,
    interpolate_log,
    interpolate_table,
)

CONTRAST = 0.2  # rms contrast of a natural picture
UNSEEN = 0.5 / 255  # rms error that nobody needs to go below
TILT_ERROR = 0.35  # of the tilt's spread, per D between nodes
TILT_SHARE = 0.06  # of the spread, that interpolating the tilt may err by


@dataclass(frozen=True)
class Fidelity:
    """One atmosphere in pixels, and how it is simulated; names as in Atmosphere mean the same.

    `tilt_correlation_time_s`: to 1 / e, of the AR(1) model; `aperture_px`: D at the object;
    `tilt_px`: standard deviation along one axis; `blur_px`: the radius that holds half of the light
    of a point, tilt removed.  `zernike_modes` from tilt on; `psf_network`: the one that turns them
    into weights of `psf_rank` basis functions; `*_grid_pitch_px`: pixels between the nodes of the
    phase.  `error_psf` (modes left out, network and basis), `error_grid`, `error_kernel`: shares of
    the random power; `error`: the rms error they make together, of an image's contrast.
    """

    d_over_r0: float = 0.0
    blur_equivalent_d_over_r0: float = 0.0
    severity: str = "none"
    rytov_variance: float = 0.0
    ar1_coefficient: float = 1.0
    tilt_correlation_time_s: float = math.inf
    tilt_and_blur_px: float = 0.0
    tilt_correlation_half_length_px: float = math.inf
    aperture_px: float = 0.0
    aperture_over_outer_scale: float = 0.0
    tilt_px: float = 0.0
    lambda_over_d_px: float = 0.0
    blur_px: float = 0.0
    zernike_modes: int = 0
    psf_network: int = 0
    psf_rank: int = 0
    psf_size_px: int = 1
    psf_grid_pitch_px: int = 1
    tilt_grid_pitch_px: int = 1
    error_psf: float = 0.0
    error_grid: float = 0.0
    error_kernel: float = 0.0
    error_tilt_px: float = 0.0
    error: float = 0.0


def choose_fidelity(atmosphere: Atmosphere, width_px: int, tolerance: float) -> Fidelity:
    """Return the cheapest fidelity whose errors keep within `tolerance` of the random power.

    An rms error of half a grey level of 256 is always allowed.
    Raises ValueError for turbulence that is too strong.
    """
    unit, strength = atmosphere.lambda_over_d_px(width_px), atmosphere.blur_equivalent_d_over_r0
    power = _random_power(strength, unit)
    allowed = max(tolerance, (UNSEEN / CONTRAST) ** 2 / power)
    pixel = atmosphere.pixel_size_at_object_m(width_px) / atmosphere.aperture_m
    patch = pixel / _isoplanatic_patch_ratio(atmosphere)
    psf = choose_psf_settings(find_psf_band(strength), strength, unit, patch, allowed)
    tilt_px, ar1 = atmosphere.tilt_std_px(width_px), atmosphere.ar1_coefficient
    tilt_pitch, error_tilt = _tilt_pitch(patch, tilt_px, unit, atmosphere.d_over_r0)
    return Fidelity(
        d_over_r0=atmosphere.d_over_r0,
        blur_equivalent_d_over_r0=strength,
        severity=atmosphere.severity,
        rytov_variance=atmosphere.rytov_variance,
        ar1_coefficient=ar1,
        tilt_correlation_time_s=-1 / (AR1_FPS * math.log(ar1)) if 0 < ar1 < 1 else 0.0,
        tilt_and_blur_px=atmosphere.tilt_and_blur_px(width_px),
        tilt_correlation_half_length_px=atmosphere.tilt_correlation_half_length_px(width_px),
        aperture_px=atmosphere.aperture_m / atmosphere.pixel_size_at_object_m(width_px),
        aperture_over_outer_scale=atmosphere.aperture_over_outer_scale,
        tilt_px=tilt_px,
        lambda_over_d_px=unit,
        blur_px=unit * half_light_radius(strength),
        tilt_grid_pitch_px=tilt_pitch,
        error_tilt_px=error_tilt,
        error=math.sqrt(power * (psf.error_psf + psf.error_grid + psf.error_kernel)),
        **psf._asdict(),
    )


def mean_psf(d_over_r0: float) -> Float[Tensor, "fine fine"]:
    """Return the mean PSF at `d_over_r0`, tilt removed, as stored."""
    return interpolate_log(error_table("mean"), error_table("strength"), d_over_r0)


def _isoplanatic_patch_ratio(atmosphere: Atmosphere) -> float:
    """Return how large the patches of like phase are, over those of a constant Cn2.

    The ratio of theta0 L / r0, Kolmogorov's: an outer scale does not change small distances.
    """
    place, strength = atmosphere.path_slices
    near = float((strength * (1 - place) ** (5 / 3)).sum())
    return (near / float((strength * place ** (5 / 3)).sum())) ** 0.6


def _tilt_pitch(
    pixel_d: float, tilt_px: float, lambda_over_d_px: float, d_over_r0: float
) -> tuple[int, float]:
    """Return the widest pitch within 0.03 px or TILT_SHARE of the spread, and its error.

    Cubic interpolation between nodes S D apart leaves an rms error of 0.35 S of the spread that
    Kolmogorov's tilt has, measured on 30,000 waves for a constant Cn2; an outer scale takes away
    long waves only, so the error stays.
    """
    allowed = max(0.03, TILT_SHARE * tilt_px)
    kolmogorov = 2 / math.pi * lambda_over_d_px * math.sqrt(TILT_VARIANCE) * d_over_r0 ** (5 / 6)
    error = TILT_ERROR * pixel_d * kolmogorov
    pitch = int(min(max(allowed / error, 1), MAX_PITCH))
    return pitch, error * pitch if pitch > 1 else 0.0


def _random_power(d_over_r0: float, lambda_over_d_px: float) -> float:
    """Return the power of the random change of a picture of unit contrast; grows as d^(5/3)."""
    weak = min(d_over_r0 / float(error_table("strength")[0]), 1.0) ** (5 / 3)
    return max(float(interpolate_table("power", d_over_r0, lambda_over_d_px)) * weak, 1e-30)
