"""One atmosphere and one camera as numbers, and what follows from them.

z is the distance from the camera, 0..L; the object stands at L.  Lengths in metres, angles in
radians, pixels of a frame `width_px` wide.  k = 2 pi / wavelength.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from src.sim.turbulence import outer_scale
from src.sim.turbulence.seeing import blur_growth

WEAK_BELOW, STRONG_FROM = 0.5, 1.2  # spread in px of a frame 256 wide; see docs/simulation.md
ALPHA_FPS = 120.0  # the frame rate that `alpha` is stated for
REFERENCE_PX = 256  # the width of the frame that severities speak of
TILT_VARIANCE = 0.448879  # of Noll's a2 and a3 at D/r0 = 1, in rad^2


@dataclass(frozen=True)
class Atmosphere:
    """A path through turbulence seen by a camera focused on the object.

    `aperture_m` D, `focal_length_m` f, `distance_m` L, `scene_width_m` the width the frame covers
    at the object, `wavelength_m`, `cn2` in m^(-2/3): a number, or values at the camera, ..., at the
    object, equally spaced and joined linearly.  `alpha`: correlation of the turbulence from one
    frame to the next at 120 frames per second.  `outer_scale_m` L0: the size of the largest eddies
    (von Karman); inf is Kolmogorov's air.  `wind_m_s`: mean speed of the wind across the path.
    Raises ValueError for numbers outside their range.
    """

    aperture_m: float
    focal_length_m: float
    distance_m: float
    scene_width_m: float
    wavelength_m: float
    cn2: float | tuple[float, ...]
    alpha: float
    outer_scale_m: float = math.inf
    wind_m_s: float = 3.0

    def __post_init__(self):
        names = ("aperture_m", "focal_length_m", "distance_m", "scene_width_m", "wavelength_m")
        for name in names:
            _require(0 < getattr(self, name) < math.inf, name, "> 0", getattr(self, name))
        _require(0 <= self.alpha <= 1, "alpha", "in [0, 1]", self.alpha)
        _require(self.outer_scale_m > 0, "outer_scale_m", "> 0", self.outer_scale_m)
        _require(0 <= self.wind_m_s < math.inf, "wind_m_s", ">= 0", self.wind_m_s)
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
        """What is seen: `weak`, `medium` or `strong`, by `spread_px` of a frame 256 wide."""
        spread = self.spread_px(REFERENCE_PX)
        if spread < WEAK_BELOW:
            return "weak"
        return "medium" if spread < STRONG_FROM else "strong"

    @cached_property
    def shape(self) -> tuple[float, ...]:
        """The profile of Cn2 with a sum of 1: where along the path the turbulence is."""
        total = math.fsum(self.profile)
        return tuple(value / total for value in self.profile) if total > 0 else (1.0,)

    @property
    def inverse_outer_scale(self) -> float:
        """D / L0."""
        return self.aperture_m / self.outer_scale_m

    @cached_property
    def blurring_d_over_r0(self) -> float:
        """D / r0 of the Kolmogorov air whose modes beyond tilt are as strong as this air's."""
        left = outer_scale.left(self.inverse_outer_scale, self.shape, "higher")
        return self.d_over_r0 * left**0.6

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

        (2 / pi) (lambda / D) sqrt(0.4489 (D/r0)^(5/3)) f / p (Noll 1976; Tyler 1994), times what
        the outer scale leaves of it.
        """
        left = outer_scale.left(self.inverse_outer_scale, self.shape, "tilt")
        spread = math.sqrt(TILT_VARIANCE * left) * self.d_over_r0 ** (5 / 6)
        return 2 / math.pi * self.airy_px(width_px) * spread

    def spread_px(self, width_px: int) -> float:
        """How far turbulence spreads a point over time, along one axis, in pixels (rms).

        Tilt and blur in quadrature; of the blur what exceeds diffraction, as the standard
        deviation of the Gaussian that holds half of its light within the same radius.
        """
        blur = self.airy_px(width_px) * blur_growth(self.blurring_d_over_r0)
        return math.hypot(self.tilt_std_px(width_px), blur)

    def half_length_px(self, width_px: int) -> float:
        """The distance at which the correlation of the tilt falls to 1/2, in pixels."""
        reach = outer_scale.tilt_reach(self.inverse_outer_scale, self.shape)
        return reach * self.aperture_m / self.object_pixel_m(width_px)

    def at(self, d_over_r0: float) -> "Atmosphere":
        """Return the same path and camera with Cn2 scaled to give `d_over_r0`."""
        _require(0 <= d_over_r0 < math.inf, "d_over_r0", ">= 0", d_over_r0)
        unit = replace(self, cn2=tuple(value or 0.0 for value in self.profile))
        scale = (d_over_r0 / unit.d_over_r0) ** (5 / 3)
        return replace(self, cn2=tuple(value * scale for value in self.profile))

    @property
    def _k(self) -> float:
        return 2 * math.pi / self.wavelength_m


def _require(valid: bool, name: str, allowed: str, value: object) -> None:
    if not valid:
        raise ValueError(f"turbulence.atmosphere.{name} must be {allowed}, got {value}")
