"""How an atmosphere is drawn: by what a picture shows (`seen`), or by camera and weather (`rigid`).

Real air warps a picture locally: its tilt is correlated over some 10 to 25 px of a frame of 256.
`seen` therefore draws what is seen - spread, half length of the tilt, time of decay - and then
camera, path and outer scale that give it.  `rigid` draws lenses, distances and Cn2 independently
and rejects what scintillates; almost all of its tilt then moves the whole view as one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float

from src.sim.turbulence import outer_scale
from src.sim.turbulence.atmosphere import (
    ALPHA_FPS, REFERENCE_PX, STRONG_FROM, TILT_VARIANCE, WEAK_BELOW, Atmosphere,
)  # fmt: skip
from src.sim.turbulence.seeing import blur_growth

MIX = {"weak": 0.1, "medium": 0.3, "strong": 0.6}  # of the paper's data set
SPREADS = {
    "weak": (0.1, WEAK_BELOW),
    "medium": (WEAK_BELOW, STRONG_FROM),
    "strong": (STRONG_FROM, 3.0),
}
PLACES = {"uniform": (0, 1), "camera": (0, 0.1), "middle": (1 / 3, 2 / 3), "object": (0.7, 1)}
KNOTS = 121  # of a profile
CANDIDATES, ROUNDS = 128, 4  # cameras proposed at a time, and how often
SCALES = np.geomspace(1, 100, 17)  # L0 / D that are drawn from, and infinity
STRENGTHS = np.geomspace(0.05, 10, 100)  # D/r0 that are drawn from
Range = Sequence[float]
Draws = Float[np.ndarray, " candidates"]


@dataclass(frozen=True)
class Appearance:
    """What a picture shall show, in pixels of a frame 256 wide: `half_length_px` of the tilt,
    `decay_s` to 1 / e, and either `spread_px` (see Atmosphere) or `tilt_px`, rms along one axis.

    `blur_px`: the blur beyond diffraction, rms along one axis, that is wanted most; None: any.
    """

    half_length_px: float
    decay_s: float
    spread_px: float | None = None
    tilt_px: float | None = None
    blur_px: float | None = None


def sample_atmosphere(
    severity: str,
    generator: torch.Generator,
    *,
    spread_px: Mapping[str, Range] | None = None,
    half_length_px: Range = (5.0, 100.0),
    near_rigid: float = 0.15,
    rigid_half_length_px: Range = (100.0, 600.0),
    decay_s: Range = (0.02, 0.25),
    **cameras,
) -> Atmosphere | None:
    """Draw an atmosphere of `severity`: weak, medium, strong or mixed (10/30/60 %).

    All ranges are log-uniform, in pixels of a frame 256 wide: `spread_px` for each severity,
    `half_length_px`, or at a probability of `near_rigid` that of `rigid_half_length_px`; `decay_s`
    in seconds.  What no camera shows is drawn again.  `cameras`: see `_find`.  `none` gives
    None.  Raises ValueError for an unknown severity or ranges that nothing meets.
    """
    if severity == "none":
        return None
    spread_px = (SPREADS | dict(spread_px or {}))[_choose(severity, generator)]
    if not 0 <= near_rigid <= 1:
        raise _refused("near_rigid", "in [0, 1]", near_rigid)
    for _ in range(32):
        u = torch.rand(4, generator=generator, dtype=torch.float64).numpy()
        lengths = (half_length_px, "half_length_px")
        if u[0] < near_rigid:
            lengths = (rigid_half_length_px, "rigid_half_length_px")
        seen = Appearance(
            half_length_px=float(log_between(u[1], *lengths)),
            decay_s=float(log_between(u[2], decay_s, "decay_s")),
            spread_px=float(log_between(u[3], spread_px, "spread_px")),
        )
        found = _find(seen, generator, **cameras)
        if found is not None:
            return found
    raise ValueError(f"turbulence.atmosphere: no camera within its ranges shows {seen}")


def matching(seen: Appearance, generator: torch.Generator, **cameras) -> Atmosphere:
    """Draw a camera and a path that show what is asked for; see `_find`.

    Raises ValueError where there is none.
    """
    found = _find(seen, generator, **cameras)
    if found is None:
        raise ValueError(f"turbulence.atmosphere: no camera within its ranges shows {seen}")
    return found


def _find(
    seen: Appearance,
    generator: torch.Generator,
    *,
    airy_px: Range = (0.4, 2.0),
    aperture_px: Range = (1.0, 60.0),
    outer_scale_d: Range = (1.0, 100.0),
    kolmogorov: float = 0.2,
    profiles: Sequence[str | Sequence[float]] = tuple(PLACES),
    rytov_max: float = 3.0,
    distance_m: Range = (100.0, 5000.0),
    f_number: Range = (2.8, 24.0),
    wavelength_m: float = 525e-9,
    width_px: int = REFERENCE_PX,
) -> Atmosphere | None:
    """Draw a camera and a path that show what is asked for; None where none is found.

    `airy_px` lambda / D in pixels, `aperture_px` the aperture in pixels at the object,
    `outer_scale_d` L0 / D, without outer scale at a probability of `kolmogorov`; `profiles`: where
    the turbulence lies, `uniform`, `camera` (the first tenth), `middle` (third), `object` (the last
    30 %) or a table of Cn2 from the camera to the object.  Beyond `rytov_max` scintillation, which
    is left out, is too strong.
    """
    shapes = [profile(shape) for shape in profiles]
    for _ in range(ROUNDS):
        u = torch.rand(CANDIDATES, 6, generator=generator, dtype=torch.float64).numpy()
        airy = log_between(u[:, 0], airy_px, "airy_px")
        shape = (u[:, 1] * len(shapes)).astype(int)
        scale = _scales(u[:, 2], outer_scale_d, kolmogorov)
        reach, tilt, higher, scatter = np.array(
            [_facts(shapes[s], 1 / x) for s, x in zip(shape, scale, strict=True)]
        ).T
        aperture = seen.half_length_px / reach
        strength, blur = _strength(seen, airy, tilt, higher)
        rytov = 5.319 * strength ** (5 / 3) * (2 * math.pi * aperture / airy) ** (-5 / 6) * scatter
        fits = (aperture >= aperture_px[0]) & (aperture <= aperture_px[1]) & (rytov <= rytov_max)
        fits &= np.isfinite(strength)
        if not fits.any():
            continue
        unlike = np.abs(np.log(blur / seen.blur_px)) if seen.blur_px else np.arange(CANDIDATES)
        i = int(np.where(fits, unlike, np.inf).argmin())
        length = float(log_between(u[i, 3], distance_m, "distance_m"))
        diameter = math.sqrt(wavelength_m * length * aperture[i] / airy[i])
        return Atmosphere(
            aperture_m=diameter,
            focal_length_m=diameter * float(log_between(u[i, 4], f_number, "f_number")),
            distance_m=length,
            scene_width_m=width_px * diameter / float(aperture[i]),
            wavelength_m=wavelength_m,
            cn2=shapes[shape[i]],
            alpha=math.exp(-1 / (ALPHA_FPS * seen.decay_s)),
            outer_scale_m=diameter * float(scale[i]),
            wind_m_s=_decay(shapes[shape[i]], 1 / scale[i]) * diameter / seen.decay_s,
        ).at(float(strength[i]))
    return None


def profile(shape: str | Sequence[float]) -> tuple[float, ...]:
    """Return Cn2 along the path, in any unit: of a name of PLACES, or a table as it is.

    Raises ValueError for another name and for a table that is not positive somewhere.
    """
    if isinstance(shape, str):
        if shape not in PLACES:
            raise _refused("profiles", f"of {', '.join(PLACES)} or tables", shape)
        place = np.linspace(0, 1, KNOTS)
        low, high = PLACES[shape]
        return tuple(((place >= low) & (place <= high)).astype(float).tolist())
    values = tuple(float(value) for value in shape)
    if not values or min(values) < 0 or not 0 < sum(values) < math.inf:
        raise _refused("profiles", "tables of Cn2 >= 0, somewhere > 0", list(values))
    return values


def rigid_atmosphere(
    severity: str,
    generator: torch.Generator,
    *,
    distance_m: Range = (30.0, 1000.0),
    focal_length_m: Range = (0.1, 1.0),
    f_number: Range = (2.8, 24.0),
    cn2: Range = (0.5e-14, 300e-14),
    airy_px: Range = (0.4, 2.0),
    width_px: int = REFERENCE_PX,
    wavelength_m: float = 525e-9,
    alpha: Range = (0.7, 0.95),
    rytov_max: float = 0.3,
) -> Atmosphere | None:
    """Draw lens, distance and Cn2 of `severity` by D/r0: weak 0.1-1.5, medium to 4, strong to 10.

    Distance and alpha are uniform in their range, the rest log-uniform; `airy_px` is lambda / D in
    pixels of a frame `width_px` wide and fixes the width of the scene.  Draws outside the D/r0 of
    the severity, or above `rytov_max`, are rejected.  Raises as `sample_atmosphere` does.
    """
    if severity == "none":
        return None
    chosen = _choose(severity, generator)
    low, high = {"weak": (0.1, 1.5), "medium": (1.5, 4.0), "strong": (4.0, 10.0)}[chosen]
    for _ in range(64):
        u = torch.rand(4096, 6, generator=generator, dtype=torch.float64).numpy()
        length = _between(u[:, 0], distance_m, "distance_m")
        focal = log_between(u[:, 1], focal_length_m, "focal_length_m")
        aperture = focal / log_between(u[:, 2], f_number, "f_number")
        strength = log_between(u[:, 3], cn2, "cn2")
        k = 2 * math.pi / wavelength_m
        ratio = aperture * (0.423 * 3 / 8 * k**2 * strength * length) ** 0.6
        rytov = 0.4965 * strength * k ** (7 / 6) * length ** (11 / 6)
        fits = (ratio >= low) & (ratio < high) & (rytov <= rytov_max)
        if not fits.any():
            continue
        i = int(fits.nonzero()[0][0])
        sampling = float(log_between(u[i, 4], airy_px, "airy_px"))
        diffraction = wavelength_m * float(length[i] / aperture[i])
        return Atmosphere(
            aperture_m=float(aperture[i]),
            focal_length_m=float(focal[i]),
            distance_m=float(length[i]),
            scene_width_m=width_px * diffraction / sampling,
            wavelength_m=wavelength_m,
            cn2=float(strength[i]),
            alpha=float(_between(u[i, 5], alpha, "alpha")),
        )
    raise ValueError(f"turbulence.atmosphere: no draw within its ranges is {chosen}")


PRIORS = {"seen": sample_atmosphere, "rigid": rigid_atmosphere}


def draw_atmosphere(
    generator: torch.Generator, *, prior: str | None = None, **settings
) -> Atmosphere | None:
    """Draw from the prior `seen` or `rigid`; None: the one that the settings are of.

    A config that was written before there were two has a range of `cn2`, and is rigid.
    """
    prior = prior or ("rigid" if "cn2" in settings else "seen")
    if prior not in PRIORS:
        raise _refused("prior", f"of {', '.join(PRIORS)}", prior)
    return PRIORS[prior](generator=generator, **settings)


def log_between(u: Draws | float, limits: Range, name: str) -> Draws | float:
    """Return log-uniform numbers in `limits` from uniform ones in [0, 1]."""
    if not limits[0] > 0:
        raise _refused(name, "a range above 0", list(limits))
    return np.exp(_between(u, [math.log(limit) for limit in limits], name))


def _between(u: Draws | float, limits: Range, name: str) -> Draws | float:
    low, high = limits
    if not -math.inf < low <= high < math.inf:
        raise _refused(name, "a range low <= high", list(limits))
    return low + (high - low) * u


def _choose(severity: str, generator: torch.Generator) -> str:
    if severity in MIX:
        return severity
    if severity != "mixed":
        raise _refused("severity", ", ".join(["none", *MIX, "mixed"]), severity)
    u = float(torch.rand((), generator=generator, dtype=torch.float64))
    return "weak" if u < MIX["weak"] else "medium" if u < 1 - MIX["strong"] else "strong"


def _scales(u: Draws, limits: Range, kolmogorov: float) -> Draws:
    """Return L0 / D: SCALES within `limits` alike, and inf at a probability of `kolmogorov`."""
    if not 0 <= kolmogorov <= 1:
        raise _refused("kolmogorov", "in [0, 1]", kolmogorov)
    low, high = limits
    if not 0 < low <= high:
        raise _refused("outer_scale_d", "a range above 0", list(limits))
    inside = SCALES[(SCALES >= low * 0.999) & (SCALES <= high * 1.001)]
    inside = inside if len(inside) else np.array([math.sqrt(low * high)])
    index = ((u - kolmogorov) / max(1 - kolmogorov, 1e-9) * len(inside)).astype(int)
    return np.where(u < kolmogorov, math.inf, inside[index.clip(0, len(inside) - 1)])


def _strength(
    seen: Appearance, airy: Draws, tilt: Draws, higher: Draws
) -> tuple[Draws, Draws]:
    """Return the D/r0 that shows what is asked for, nan beyond STRENGTHS, and its blur in pixels.

    `tilt`, `higher`: what the outer scale leaves of the variance of these modes.
    """
    shift = 2 / math.pi * np.sqrt(TILT_VARIANCE * tilt)[:, None] * STRENGTHS ** (5 / 6)
    growth = np.interp(higher[:, None] ** 0.6 * STRENGTHS, *_growth())
    wanted = seen.tilt_px if seen.spread_px is None else seen.spread_px
    shown = airy[:, None] * (shift if seen.spread_px is None else np.hypot(shift, growth))
    rows = [
        (np.interp(wanted, row, STRENGTHS, np.nan, np.nan), np.interp(wanted, row, blur))
        for row, blur in zip(shown, airy[:, None] * growth, strict=True)
    ]
    strength, blur = np.array(rows).T
    return strength, blur


@cache
def _growth() -> tuple[np.ndarray, np.ndarray]:
    strengths = np.concatenate([[0.0], STRENGTHS])
    return strengths, np.array([blur_growth(strength) for strength in strengths])


@cache
def _facts(shape: tuple[float, ...], ratio: float) -> tuple[float, float, float, float]:
    """Return half length in D, the shares that D / L0 = `ratio` leaves of tilt and of higher modes,
    and the Rytov variance over that of the same D/r0 and Fresnel number, in Atmosphere's constants.
    """
    place = (np.arange(2048) + 0.5) / 2048
    strength = np.interp(place, np.linspace(0, 1, len(shape)), shape) if len(shape) > 1 else 1.0
    scatter = (strength * (place * (1 - place)) ** (5 / 6)).sum()
    return (
        outer_scale.tilt_reach(ratio, shape),
        outer_scale.left(ratio, shape, "tilt"),
        outer_scale.left(ratio, shape, "higher"),
        float(scatter / (strength * (1 - place) ** (5 / 3)).sum()),
    )


@cache
def _decay(shape: tuple[float, ...], ratio: float) -> float:
    """Return the way of the wind, in D, after which the tilt's correlation is 1 / e."""
    return outer_scale.tilt_reach(ratio, shape, wind=True)


def _refused(name: str, allowed: str, value: object) -> ValueError:
    return ValueError(f"turbulence.atmosphere.{name} must be {allowed}, got {value}")
