"""How an atmosphere is drawn: by what a picture shows of it.

Real air warps a picture locally: its tilt is correlated over some 10 to 25 px of a frame of 256.
So what is seen is drawn - spread, half length of the tilt, time of decay - and then a camera, a
path and an outer scale that show it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from src.sim.turbulence import outer_scale
from src.sim.turbulence.atmosphere import (
    ALPHA_FPS,
    REFERENCE_PX,
    STRONG_FROM,
    TILT_VARIANCE,
    WEAK_BELOW,
    Atmosphere,
)  # fmt: skip
from src.sim.turbulence.ranges import Draws, Range, choose_severity, log_between, refused
from src.sim.turbulence.seeing import GAUSSIAN, blur_growth, half_light

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


@dataclass(frozen=True)
class Appearance:
    """What a picture shall show, in pixels of a frame 256 wide: `half_length_px` of the tilt,
    `decay_s` to 1 / e, and either `spread_px` (see Atmosphere) or `tilt_px`, rms along one axis.

    Of all that shows this, wanted most are `blur_px`, the blur beyond diffraction, rms along one
    axis, `blur_ratio`, that of the blurred point to the sharp one, and `whole_share`, the share of
    the tilt that moves the whole view; None: any.
    """

    half_length_px: float
    decay_s: float
    spread_px: float | None = None
    tilt_px: float | None = None
    blur_px: float | None = None
    blur_ratio: float | None = None
    whole_share: float | None = None


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
    spread_px = (SPREADS | dict(spread_px or {}))[choose_severity(severity, generator)]
    if not 0 <= near_rigid <= 1:
        raise refused("near_rigid", "in [0, 1]", near_rigid)
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
        atmosphere = _find(seen, generator, **cameras)
        if atmosphere is not None:
            return atmosphere
    raise ValueError(f"turbulence.atmosphere: no camera within its ranges shows {seen}")


def matching(seen: Appearance, generator: torch.Generator, **cameras) -> Atmosphere:
    """Draw a camera and a path that show what is asked for; see `_find`.

    Raises ValueError where there is none.
    """
    atmosphere = _find(seen, generator, **cameras)
    if atmosphere is None:
        raise ValueError(f"turbulence.atmosphere: no camera within its ranges shows {seen}")
    return atmosphere


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
        facts = [_facts(shapes[s], 1 / x) for s, x in zip(shape, scale, strict=True)]
        reach, tilt, higher, scatter = np.array(facts).T
        aperture = seen.half_length_px / reach
        strength, blur = _strength(seen, airy, tilt, higher)
        rytov = 5.319 * strength ** (5 / 3) * (2 * math.pi * aperture / airy) ** (-5 / 6) * scatter
        fits = (aperture >= aperture_px[0]) & (aperture <= aperture_px[1]) & (rytov <= rytov_max)
        fits &= np.isfinite(strength)
        if not fits.any():
            continue
        unlike = _unlike(seen, blur, airy, [shapes[s] for s in shape], 1 / scale, aperture)
        i = int(np.where(fits, unlike, np.inf).argmin())
        length = float(log_between(u[i, 3], distance_m, "distance_m"))
        diameter = math.sqrt(wavelength_m * length * aperture[i] / airy[i])
        # Of the wind, in D, after which the tilt's correlation is 1 / e.
        way = outer_scale.tilt_reach(1 / scale[i], shapes[shape[i]], wind=True)
        return Atmosphere(
            aperture_m=diameter,
            focal_length_m=diameter * float(log_between(u[i, 4], f_number, "f_number")),
            distance_m=length,
            scene_width_m=width_px * diameter / float(aperture[i]),
            wavelength_m=wavelength_m,
            cn2=shapes[shape[i]],
            alpha=math.exp(-1 / (ALPHA_FPS * seen.decay_s)),
            outer_scale_m=diameter * float(scale[i]),
            wind_m_s=way * diameter / seen.decay_s,
        ).at(float(strength[i]))
    return None


def profile(shape: str | Sequence[float]) -> tuple[float, ...]:
    """Return Cn2 along the path, in any unit: of a name of PLACES, or a table as it is.

    Raises ValueError for another name and for a table that is not positive somewhere.
    """
    if isinstance(shape, str):
        if shape not in PLACES:
            raise refused("profiles", f"of {', '.join(PLACES)} or tables", shape)
        place = np.linspace(0, 1, KNOTS)
        low, high = PLACES[shape]
        return tuple(((place >= low) & (place <= high)).astype(float).tolist())
    values = tuple(float(value) for value in shape)
    if not values or min(values) < 0 or not 0 < sum(values) < math.inf:
        raise refused("profiles", "tables of Cn2 >= 0, somewhere > 0", list(values))
    return values


def _scales(u: Draws, limits: Range, kolmogorov: float) -> Draws:
    """Return L0 / D: SCALES within `limits` alike, and inf at a probability of `kolmogorov`."""
    if not 0 <= kolmogorov <= 1:
        raise refused("kolmogorov", "in [0, 1]", kolmogorov)
    low, high = limits
    if not 0 < low <= high:
        raise refused("outer_scale_d", "a range above 0", list(limits))
    inside = SCALES[(low * 0.999 <= SCALES) & (high * 1.001 >= SCALES)]
    inside = inside if len(inside) else np.array([math.sqrt(low * high)])
    index = ((u - kolmogorov) / max(1 - kolmogorov, 1e-9) * len(inside)).astype(int)
    return np.where(u < kolmogorov, math.inf, inside[index.clip(0, len(inside) - 1)])


def _strength(seen: Appearance, airy: Draws, tilt: Draws, higher: Draws) -> tuple[Draws, Draws]:
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


def _unlike(
    seen: Appearance,
    blur: Draws,
    airy: Draws,
    shapes: Sequence[tuple[float, ...]],
    ratio: Draws,
    aperture: Draws,
) -> Draws:
    """Return how far every candidate is from what is wanted most: 0.1 for 10 % of blur, or a tenth
    of whole view."""
    apart = np.zeros(len(blur))
    if seen.blur_px is not None:
        apart += np.abs(np.log(blur / seen.blur_px))
    if seen.blur_ratio is not None:
        sharp = airy * half_light(0.0) / GAUSSIAN
        apart += np.abs(np.log(np.hypot(1, blur / sharp) / seen.blur_ratio))
    if seen.whole_share is not None:
        views = REFERENCE_PX / aperture
        shares = [outer_scale.whole_share(*one) for one in zip(ratio, shapes, views, strict=True)]
        apart += np.abs(np.array(shares) - seen.whole_share)
    return apart


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
