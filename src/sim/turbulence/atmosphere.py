"""One atmosphere and one camera as numbers, what follows from them, and how they are drawn.

z is the distance from the camera, 0..L; the object stands at L.  Lengths in metres, angles in
radians, pixels of a frame `width_px` wide.  k = 2 pi / wavelength.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

WEAK_BELOW, STRONG_FROM, STRONG_TO = 1.5, 4.0, 10.0  # D/r0; ours, see docs/simulation.md
MIX = {"weak": 0.1, "medium": 0.3, "strong": 0.6}  # of the paper's data set
TILT_VARIANCE = 0.448879  # of Noll's a2 and a3 at D/r0 = 1, in rad^2
CANDIDATES = 4096  # atmospheres proposed per round of rejection
Range = tuple[float, float] | list[float]


@dataclass(frozen=True)
class Atmosphere:
    """A path through turbulence seen by a camera focused on the object.

    `aperture_m` D, `focal_length_m` f, `distance_m` L, `scene_width_m` the width the frame covers
    at the object, `wavelength_m`, `cn2` in m^(-2/3): a number, or values at the camera, ..., at the
    object, equally spaced and joined linearly.  `alpha`: correlation of the turbulence from one
    frame to the next at 120 frames per second.  Raises ValueError for numbers outside their range.
    """

    aperture_m: float
    focal_length_m: float
    distance_m: float
    scene_width_m: float
    wavelength_m: float
    cn2: float | tuple[float, ...]
    alpha: float

    def __post_init__(self):
        names = ("aperture_m", "focal_length_m", "distance_m", "scene_width_m", "wavelength_m")
        for name in names:
            _require(0 < getattr(self, name) < math.inf, name, "> 0", getattr(self, name))
        _require(0 <= self.alpha <= 1, "alpha", "in [0, 1]", self.alpha)
        profile = self.profile
        valid = len(profile) > 0 and all(0 <= value < math.inf for value in profile)
        _require(valid, "cn2", ">= 0", self.cn2)

    @property
    def profile(self) -> tuple[float, ...]:
        """Cn2 at equally spaced points from the camera to the object."""
        return (self.cn2,) if isinstance(self.cn2, int | float) else tuple(self.cn2)

    @cached_property
    def path(self) -> tuple[Tensor, Tensor]:
        """Where the turbulence is: z / L of 2048 slices and each slice's Int Cn2 dz, in float64."""
        place = (torch.arange(2048, dtype=torch.float64) + 0.5) / 2048
        knots = torch.tensor(self.profile, dtype=torch.float64)
        at = place * (len(knots) - 1)
        low = at.floor().long()
        high = (low + 1).clamp(max=len(knots) - 1)
        strength = knots[low] + (knots[high] - knots[low]) * (at - low)
        return place, strength * (self.distance_m / 2048)

    @property
    def r0_m(self) -> float:
        """Fried parameter of a point at the object (spherical wave); inf without turbulence.

        r0 = [0.423 k^2 Int Cn2(z) (1 - z/L)^(5/3) dz]^(-3/5) (Fried 1966).
        """
        place, strength = self.path
        integral = 0.423 * self._k**2 * float((strength * (1 - place) ** (5 / 3)).sum())
        return integral**-0.6 if integral > 0 else math.inf

    @property
    def d_over_r0(self) -> float:
        """D / r0."""
        return self.aperture_m / self.r0_m

    @property
    def severity(self) -> str:
        """`weak` (D/r0 < 1.5), `medium` (< 4) or `strong`."""
        if self.d_over_r0 < WEAK_BELOW:
            return "weak"
        return "medium" if self.d_over_r0 < STRONG_FROM else "strong"

    @property
    def isoplanatic_angle_rad(self) -> float:
        """theta0 = [2.914 k^2 Int Cn2 z^(5/3) dz]^(-3/5) (Fried 1982), seen from the camera."""
        place, strength = self.path
        weighted = (strength * (place * self.distance_m) ** (5 / 3)).sum()
        integral = 2.914 * self._k**2 * float(weighted)
        return integral**-0.6 if integral > 0 else math.inf

    @property
    def rytov(self) -> float:
        """Rytov variance of a spherical wave; above 0.3 scintillation, left out here, matters.

        2.25 k^(7/6) Int Cn2 [z (1 - z/L)]^(5/6) dz, 0.5 Cn2 k^(7/6) L^(11/6) for a constant Cn2
        (Andrews & Phillips, 2nd ed., ch. 8).
        """
        place, strength = self.path
        weighted = strength * (place * (1 - place) * self.distance_m) ** (5 / 6)
        return 2.25 * self._k ** (7 / 6) * float(weighted.sum())

    def pixel_pitch_m(self, width_px: int) -> float:
        """Pitch of a pixel on the sensor: p = f * scene width / (L * width)."""
        return self.focal_length_m * self.scene_width_m / (self.distance_m * width_px)

    def object_pixel_m(self, width_px: int) -> float:
        """Size of a pixel at the object."""
        return self.scene_width_m / width_px

    def airy_px(self, width_px: int) -> float:
        """The diffraction angle lambda / D in pixels: lambda f / (D p)."""
        pitch = self.pixel_pitch_m(width_px)
        return self.wavelength_m * self.focal_length_m / (self.aperture_m * pitch)

    def tilt_std_px(self, width_px: int) -> float:
        """Standard deviation of the Zernike tilt along one axis, in pixels.

        (2 / pi) (lambda / D) sqrt(0.4489 (D/r0)^(5/3)) f / p (Noll 1976; Tyler 1994).
        """
        spread = math.sqrt(TILT_VARIANCE) * self.d_over_r0 ** (5 / 6)
        return 2 / math.pi * self.airy_px(width_px) * spread

    def at(self, d_over_r0: float) -> "Atmosphere":
        """Return the same path and camera with Cn2 scaled to give `d_over_r0`."""
        _require(0 <= d_over_r0 < math.inf, "d_over_r0", ">= 0", d_over_r0)
        unit = replace(self, cn2=tuple(value or 0.0 for value in self.profile))
        scale = (d_over_r0 / unit.d_over_r0) ** (5 / 3)
        return replace(self, cn2=tuple(value * scale for value in self.profile))

    @property
    def _k(self) -> float:
        return 2 * math.pi / self.wavelength_m


def sample_atmosphere(
    severity: str,
    generator: torch.Generator,
    *,
    distance_m: Range = (30.0, 1000.0),
    focal_length_m: Range = (0.1, 1.0),
    f_number: Range = (2.8, 24.0),
    cn2: Range = (0.5e-14, 300e-14),
    airy_px: Range = (0.4, 2.0),
    width_px: int = 256,
    wavelength_m: float = 525e-9,
    alpha: Range = (0.7, 0.95),
    rytov_max: float = 0.3,
) -> Atmosphere | None:
    """Draw an atmosphere of `severity`: weak, medium, strong or mixed (10/30/60 %).

    Distance and alpha are uniform in their range, the rest log-uniform; `airy_px` is lambda / D in
    pixels of a frame `width_px` wide and fixes the width of the scene.  Draws outside the D/r0 of
    the severity (weak 0.1-1.5, medium 1.5-4, strong 4-10), or above `rytov_max`, are rejected.
    `none` gives None.  Raises ValueError for an unknown severity or ranges that never meet it.
    """
    if severity == "none":
        return None
    chosen = _choose(severity, generator)
    low, high = {
        "weak": (0.1, WEAK_BELOW),
        "medium": (WEAK_BELOW, STRONG_FROM),
        "strong": (STRONG_FROM, STRONG_TO),
    }[chosen]
    for _ in range(64):
        u = torch.rand(CANDIDATES, 6, generator=generator, dtype=torch.float64)
        length = _between(u[:, 0], distance_m, "distance_m")
        focal = _log_between(u[:, 1], focal_length_m, "focal_length_m")
        aperture = focal / _log_between(u[:, 2], f_number, "f_number")
        strength = _log_between(u[:, 3], cn2, "cn2")
        k = 2 * math.pi / wavelength_m
        ratio = aperture * (0.423 * 3 / 8 * k**2 * strength * length) ** 0.6
        rytov = 0.4965 * strength * k ** (7 / 6) * length ** (11 / 6)
        fits = (ratio >= low) & (ratio < high) & (rytov <= rytov_max)
        if not fits.any():
            continue
        i = int(fits.nonzero()[0])
        sampling = float(_log_between(u[i, 4], airy_px, "airy_px"))
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


def _choose(severity: str, generator: torch.Generator) -> str:
    if severity in MIX:
        return severity
    if severity != "mixed":
        allowed = ", ".join(["none", *MIX, "mixed"])
        raise ValueError(f"turbulence.atmosphere.severity must be {allowed}, got {severity}")
    u = float(torch.rand((), generator=generator, dtype=torch.float64))
    return "weak" if u < MIX["weak"] else "medium" if u < 1 - MIX["strong"] else "strong"


def _between(u: Float[Tensor, "*n"], limits: Range, name: str) -> Float[Tensor, "*n"]:
    low, high = limits
    _require(-math.inf < low <= high < math.inf, name, "a range low <= high", list(limits))
    return low + (high - low) * u


def _log_between(u: Float[Tensor, "*n"], limits: Range, name: str) -> Float[Tensor, "*n"]:
    _require(limits[0] > 0, name, "a range above 0", list(limits))
    logs = [math.log(limit) for limit in limits]
    return _between(u, logs, name).exp()


def _require(valid: bool, name: str, allowed: str, value: object) -> None:
    if not valid:
        raise ValueError(f"turbulence.atmosphere.{name} must be {allowed}, got {value}")
