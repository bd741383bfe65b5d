"""How an atmosphere is drawn: first what an image shows of it - tilt and blur, correlation length
and time of the tilt - then a camera, a path and an outer scale that show it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from numbers import Real
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from src.sim.turbulence import outer_scale, short_exposure
from src.sim.turbulence.atmosphere import (
    AR1_FPS,
    EXTREME_FROM_PX,
    REFERENCE_WIDTH_PX,
    STRONG_FROM_PX,
    TILT_VARIANCE,
    WEAK_BELOW_PX,
    Atmosphere,
)
from src.sim.turbulence.contract import check_option

SEVERITY_SHARES = {"weak": 0.1, "medium": 0.3, "strong": 0.6}  # of the paper's data set
TILT_AND_BLUR_PX = {
    "weak": (0.1, WEAK_BELOW_PX),
    "medium": (WEAK_BELOW_PX, STRONG_FROM_PX),
    "strong": (STRONG_FROM_PX, 3.0),
    "extreme": (EXTREME_FROM_PX, 7.0),
}
PROFILES = {"uniform": (0, 1), "camera": (0, 0.1), "middle": (1 / 3, 2 / 3), "object": (0.7, 1)}
PROFILE_POINTS = 121
CANDIDATES, ROUNDS = 128, 4  # cameras proposed at a time, and how often
DRAWS = 32  # of what an image shall show, until a camera shows it
OUTER_SCALES = 17  # values of L0 / D in a range that are drawn from, and infinity
D_OVER_R0 = np.geomspace(0.05, 10, 240)  # that are drawn from
Range = Sequence[float]
Candidates = Float[np.ndarray, " candidates"]


class NoCameraError(ValueError):
    """No camera within its ranges shows what is wanted."""


@dataclass(frozen=True)
class TargetImageStatistics:
    """What an image shall show, in pixels of a frame 256 wide: the half length of the tilt's
    correlation, its time to 1 / e, and either `tilt_and_blur_px` (see Atmosphere) or `tilt_px`, rms
    along one axis.

    Of all that shows this, wanted most are `blur_px`, the blur beyond diffraction (the standard
    deviation of a Gaussian along one axis), and `global_tilt_share`, the share of the tilt's
    variance that moves the whole view; None: any.
    """

    tilt_correlation_half_length_px: float
    tilt_correlation_time_s: float
    tilt_and_blur_px: float | None = None
    tilt_px: float | None = None
    blur_px: float | None = None
    global_tilt_share: float | None = None


def sample_atmosphere(
    severity: str, generator: torch.Generator, **ranges: Any
) -> Atmosphere | None:
    """Draw an atmosphere of `severity`: weak, medium, strong, extreme or mixed (10/30/60 % of the
    first three); `none` gives None.

    What no camera shows is drawn again as a whole, up to DRAWS times, global tilt or not: cameras
    show all that the default ranges draw.  `ranges`: see `draw_atmosphere_once`.  Raises ValueError
    for an unknown severity or ranges that nothing meets; what each setting may be, and whether
    cameras show enough of it, is checked by `SimulatedTurbulence`.
    """
    names = ["none", *TILT_AND_BLUR_PX, "mixed"]
    check_option(severity in names, "atmosphere.severity", ", ".join(names), severity)
    if severity == "none":
        return None
    if severity == "mixed":
        drawn = float(torch.rand((), generator=generator, dtype=torch.float64))
        limits = SEVERITY_SHARES["weak"], 1 - SEVERITY_SHARES["strong"]
        severity = list(SEVERITY_SHARES)[int(np.searchsorted(limits, drawn, side="right"))]
    for _ in range(DRAWS):
        try:
            return draw_atmosphere_once(severity, generator, **ranges)
        except NoCameraError as error:
            reason = error
    raise reason


def draw_atmosphere_once(
    severity: str,
    generator: torch.Generator,
    *,
    tilt_and_blur_px: Mapping[str, Range] | None = None,
    tilt_correlation_half_length_px: Range = (5.0, 100.0),
    global_tilt_probability: float = 0.15,
    global_tilt_half_length_px: Range = (100.0, 600.0),
    tilt_correlation_time_s: Range = (0.02, 0.25),
    **cameras: Any,
) -> Atmosphere:
    """Draw what an image shall show of `severity`, a key of TILT_AND_BLUR_PX, then an atmosphere.

    All ranges are log-uniform, in pixels of a frame 256 wide; `tilt_and_blur_px` for each severity;
    at `global_tilt_probability` the half length is that of turbulence that moves the whole view.
    `cameras`: see `sample_matching_atmosphere`.  Raises ValueError for wrong ranges, NoCameraError
    where no camera shows what was drawn.
    """
    spreads = (TILT_AND_BLUR_PX | dict(tilt_and_blur_px or {}))[severity]
    u = torch.rand(4, generator=generator, dtype=torch.float64).numpy()
    lengths = (tilt_correlation_half_length_px, "tilt_correlation_half_length_px")
    if u[0] < global_tilt_probability:
        lengths = (global_tilt_half_length_px, "global_tilt_half_length_px")
    wanted = TargetImageStatistics(
        float(log_uniform(u[1], *lengths)),
        float(log_uniform(u[2], tilt_correlation_time_s, "tilt_correlation_time_s")),
        tilt_and_blur_px=float(log_uniform(u[3], spreads, "tilt_and_blur_px")),
    )
    return sample_matching_atmosphere(wanted, generator, **cameras)


def sample_matching_atmosphere(
    wanted: TargetImageStatistics,
    generator: torch.Generator,
    *,
    lambda_over_d_px: Range = (0.4, 2.0),
    allowed_aperture_px: Range = (1.0, 60.0),
    outer_scale_over_aperture: Range = (1.0, 100.0),
    kolmogorov_probability: float = 0.2,
    cn2_profiles: Sequence[str | Sequence[float]] = tuple(PROFILES),
    max_rytov_variance: float = 3.0,
    distance_m: Range = (100.0, 5000.0),
    f_number: Range = (2.8, 24.0),
    wavelength_m: float = 525e-9,
    width_px: int = REFERENCE_WIDTH_PX,
) -> Atmosphere:
    """Draw a camera and a path that show what is `wanted`.

    `allowed_aperture_px`: aperture in pixels at the object; `outer_scale_over_aperture`: L0 / D,
    infinite with `kolmogorov_probability`; `cn2_profiles`: `uniform`, `camera` (the first tenth),
    `middle` (third), `object` (the last 30 %), or a table of Cn2 from the camera to the object,
    joined linearly, as those of the names are (PROFILE_POINTS: `camera` ends at 0.108 L).
    Beyond `max_rytov_variance` scintillation, which is left out, is too strong.
    Raises ValueError for wrong ranges, NoCameraError where no camera is found.
    """
    profiles = [unnormalised_cn2_profile(one) for one in cn2_profiles]
    for _ in range(ROUNDS):
        u = torch.rand(CANDIDATES, 6, generator=generator, dtype=torch.float64).numpy()
        unit = log_uniform(u[:, 0], lambda_over_d_px, "lambda_over_d_px")
        shapes = [profiles[int(k)] for k in u[:, 1] * len(profiles)]
        scale = _draw_outer_scales(u[:, 2], outer_scale_over_aperture, kolmogorov_probability)
        facts = [_path_statistics(*one) for one in zip(shapes, 1 / scale, strict=True)]
        reach, tilt, scatter = np.array(facts).T
        aperture = wanted.tilt_correlation_half_length_px / reach
        growth = [_blur_of_strengths(*one) for one in zip(shapes, 1 / scale, strict=True)]
        strength, blur = _solve_d_over_r0(wanted, unit, tilt, np.array(growth))
        rytov = 5.319 * strength ** (5 / 3) * (2 * math.pi * aperture / unit) ** (-5 / 6) * scatter
        fits = (aperture >= allowed_aperture_px[0]) & (aperture <= allowed_aperture_px[1])
        fits &= (rytov <= max_rytov_variance) & np.isfinite(strength)
        if not fits.any():
            continue
        mismatch = _mismatch(wanted, blur, shapes, 1 / scale, aperture)
        i = int(np.where(fits, mismatch, np.inf).argmin())
        length = float(log_uniform(u[i, 3], distance_m, "distance_m"))
        diameter = math.sqrt(wavelength_m * length * aperture[i] / unit[i])
        # Of the wind, in D, after which the tilt's mean correlation is 1 / e.
        way = outer_scale.tilt_decay_distance(1 / scale[i], shapes[i], wind=True)
        time_s = wanted.tilt_correlation_time_s
        return Atmosphere(
            aperture_m=diameter,
            focal_length_m=diameter * float(log_uniform(u[i, 4], f_number, "f_number")),
            distance_m=length,
            scene_width_m=width_px * diameter / float(aperture[i]),
            wavelength_m=wavelength_m,
            cn2=shapes[i],
            ar1_coefficient=math.exp(-1 / (AR1_FPS * time_s)),
            outer_scale_m=diameter * float(scale[i]),
            wind_m_s=way * diameter / time_s,
        ).with_d_over_r0(float(strength[i]))
    seen = ", ".join(f"{k}={v:.3g}" for k, v in vars(wanted).items() if v is not None)
    more = "wider ones, as of allowed_aperture_px or max_rytov_variance, show more"
    wanted_ranges = "ranges within which a camera shows"
    raise NoCameraError(f"turbulence.atmosphere must be {wanted_ranges} {seen}; {more}")


def unnormalised_cn2_profile(shape: Any) -> tuple[float, ...]:
    """Return Cn2 along the path, in any unit: of a name of PROFILES, or a table as it is.

    Raises ValueError for another name and for a table that is not positive somewhere.
    """
    if isinstance(shape, str):
        allowed = f"of {', '.join(PROFILES)} or tables"
        check_option(shape in PROFILES, "atmosphere.cn2_profiles", allowed, shape)
        place = np.linspace(0, 1, PROFILE_POINTS)
        low, high = PROFILES[shape]
        return tuple(((place >= low) & (place <= high)).astype(float).tolist())
    is_table = isinstance(shape, Sequence | np.ndarray) and all(isinstance(v, Real) for v in shape)
    valid = is_table and min(shape, default=-1) >= 0 and 0 < sum(shape) < math.inf
    allowed = "names or tables of Cn2 >= 0, somewhere > 0"
    check_option(valid, "atmosphere.cn2_profiles", allowed, shape)
    return tuple(map(float, shape))


def log_uniform(
    u: Float[np.ndarray, "..."] | float, limits: Range, name: str
) -> Float[np.ndarray, "..."]:
    """Return log-uniform numbers in `limits` from uniform ones in [0, 1].

    Raises ValueError, naming `turbulence.atmosphere.name`, where the limits are no range above 0.
    """
    (low, high), name = limits, f"atmosphere.{name}"
    check_option(low > 0, name, "a range above 0", list(limits))
    check_option(low <= high < math.inf, name, "a range low <= high", list(limits))
    low, high = math.log(low), math.log(high)
    return np.asarray(np.exp(low + (high - low) * u))


def _draw_outer_scales(u: Candidates, limits: Range, kolmogorov: float) -> Candidates:
    """Return L0 / D: OUTER_SCALES values, log-uniform in `limits`, alike, and inf at a probability
    `kolmogorov`."""
    scales = np.geomspace(limits[0], limits[1], OUTER_SCALES)
    index = ((u - kolmogorov) / max(1 - kolmogorov, 1e-9) * OUTER_SCALES).astype(int)
    return np.where(u < kolmogorov, math.inf, scales[index.clip(0, OUTER_SCALES - 1)])


def _solve_d_over_r0(
    wanted: TargetImageStatistics,
    unit: Candidates,
    tilt: Candidates,
    growth: Float[np.ndarray, "candidates strengths"],
) -> tuple[Candidates, Candidates]:
    """Return the D/r0 that shows what is wanted, nan beyond D_OVER_R0, and its blur in pixels.

    `unit`: lambda / D in pixels; `tilt`: what the outer scale leaves of its variance; `growth`: the
    blur at D_OVER_R0 in lambda / D.
    """
    shift = 2 / math.pi * np.sqrt(TILT_VARIANCE * tilt)[:, None] * D_OVER_R0 ** (5 / 6)
    target, given = wanted.tilt_and_blur_px, np.hypot(shift, growth)
    if target is None:
        target, given = wanted.tilt_px or 0.0, shift
    rows = [
        (np.interp(target, row, D_OVER_R0, np.nan, np.nan), np.interp(target, row, blur))
        for row, blur in zip(unit[:, None] * given, unit[:, None] * growth, strict=True)
    ]
    strength, blur = np.array(rows).T
    return strength, blur


def _mismatch(
    wanted: TargetImageStatistics,
    blur: Candidates,
    shapes: Sequence[tuple[float, ...]],
    ratio: Candidates,
    aperture: Candidates,
) -> Candidates:
    """Return how far each candidate is off: 0.1 is 10 % of blur, or of the tilt's variance."""
    total = np.zeros(len(blur))
    if wanted.blur_px is not None:
        total += np.abs(np.log(blur / wanted.blur_px))
    if wanted.global_tilt_share is not None:
        given = zip(ratio, shapes, REFERENCE_WIDTH_PX / aperture, strict=True)
        shares = np.array([outer_scale.global_tilt_share(*one) for one in given])
        total += np.abs(shares - wanted.global_tilt_share)
    return total


@lru_cache(maxsize=1024)
def _blur_of_strengths(profile: tuple[float, ...], ratio: float) -> Float[np.ndarray, " strengths"]:
    return np.asarray(short_exposure.blur_std_in_lambda_over_d(D_OVER_R0, ratio, profile))


@cache
def _path_statistics(profile: tuple[float, ...], ratio: float) -> tuple[float, float, float]:
    """Return half length in D, the share of the tilt's variance that D / L0 = `ratio` leaves, and
    the Rytov variance over that of the same D/r0 and Fresnel number, in Atmosphere's constants.
    """
    place = (np.arange(2048) + 0.5) / 2048
    strength = np.interp(place, np.linspace(0, 1, len(profile)), profile)
    scatter = (strength * (place * (1 - place)) ** (5 / 6)).sum()
    return (
        outer_scale.tilt_decay_distance(ratio, profile),
        outer_scale.tilt_variance_over_kolmogorov(ratio, profile),
        float(scatter / (strength * (1 - place) ** (5 / 3)).sum()),
    )
