"""One atmosphere and one camera as numbers, and what follows from them.

z is the distance from the camera, 0..L; the object stands at L.  Lengths in metres, angles in
radians, pixels of a frame `width_px` wide.  k = 2 pi / wavelength.
"""

import math
from bisect import bisect
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from src.sim.turbulence import outer_scale, short_exposure
from src.sim.turbulence.contract import check_option

# Tilt and blur, in px of a frame 256 wide, from which on turbulence is medium, strong, extreme.
WEAK_BELOW_PX, STRONG_FROM_PX, EXTREME_FROM_PX = 0.5, 1.2, 3.5
AR1_FPS = 120.0  # the frame rate that `ar1_coefficient` is stated for
REFERENCE_WIDTH_PX = 256  # the width of the frame that severities speak of
TILT_VARIANCE = 0.448879  # of Noll's a2 and a3 at D/r0 = 1, in rad^2


@dataclass(frozen=True)
class Atmosphere:
    """A path through turbulence seen by a camera focused on the object.

    `aperture_m` D, `focal_length_m` f, `distance_m` L, `scene_width_m` the width the frame covers
    at the object, `cn2` in m^(-2/3): a number, or values at the camera, ..., at the object, equally
    spaced and joined linearly.  `ar1_coefficient`: correlation of the turbulence from one frame to
    the next at 120 frames per second.  `outer_scale_m` L0: the size of the largest eddies (von
    Karman); inf is Kolmogorov turbulence.  `wind_m_s`: rms speed of the wind across the path.
    Raises ValueError for numbers outside their range.
    """

    aperture_m: float
    focal_length_m: float
    distance_m: float
    scene_width_m: float
    wavelength_m: float
    cn2: float | tuple[float, ...]
    ar1_coefficient: float
    outer_scale_m: float = math.inf
    wind_m_s: float = 3.0

    def __post_init__(self) -> None:
        names = ("aperture_m", "focal_length_m", "distance_m", "scene_width_m", "wavelength_m")
        profile = self.cn2_profile
        checks = {name: (0 < getattr(self, name) < math.inf, "> 0") for name in names} | {
            "ar1_coefficient": (0 <= self.ar1_coefficient <= 1, "in [0, 1]"),
            "outer_scale_m": (self.outer_scale_m > 0, "> 0"),
            "wind_m_s": (0 <= self.wind_m_s < math.inf, ">= 0"),
            "cn2": (len(profile) > 0 and all(0 <= one < math.inf for one in profile), ">= 0"),
        }
        for name, (valid, allowed) in checks.items():
            check_option(valid, f"atmosphere.{name}", allowed, getattr(self, name))

    @property
    def cn2_profile(self) -> tuple[float, ...]:
        """Cn2 at equally spaced points from the camera to the object."""
        return (self.cn2,) if isinstance(self.cn2, int | float) else tuple(self.cn2)

    @cached_property
    def integrated_cn2_by_slice(self) -> tuple[Tensor, Tensor]:
        """Where the turbulence is: z / L of 2048 slices and each slice's Int Cn2 dz, in float64."""
        place = (torch.arange(2048, dtype=torch.float64) + 0.5) / 2048
        knots = np.linspace(0, 1, len(self.cn2_profile))
        strength = np.interp(place.numpy(), knots, self.cn2_profile)
        return place, torch.from_numpy(strength) * (self.distance_m / 2048)

    @property
    def r0_m(self) -> float:
        """Fried parameter of a point at the object (spherical wave); inf without turbulence.

        r0 = [0.423 k^2 Int Cn2(z) (1 - z/L)^(5/3) dz]^(-3/5) (Fried 1966).
        """
        place, strength = self.integrated_cn2_by_slice
        integral = 0.423 * self._k**2 * float((strength * (1 - place) ** (5 / 3)).sum())
        return integral**-0.6 if integral > 0 else math.inf

    @property
    def d_over_r0(self) -> float:
        return self.aperture_m / self.r0_m

    @property
    def severity(self) -> str:
        """What is seen: `weak`, `medium`, `strong` or `extreme`, by `tilt_and_blur_px` of a frame
        256 wide."""
        spread = self.tilt_and_blur_px(REFERENCE_WIDTH_PX)
        limits = WEAK_BELOW_PX, STRONG_FROM_PX, EXTREME_FROM_PX
        return ("weak", "medium", "strong", "extreme")[bisect(limits, spread)]

    @cached_property
    def normalised_profile(self) -> tuple[float, ...]:
        """The profile of Cn2 with a sum of 1: where along the path the turbulence is."""
        total = math.fsum(self.cn2_profile)
        return tuple(value / total for value in self.cn2_profile) if total > 0 else (1.0,)

    @property
    def aperture_over_outer_scale(self) -> float:
        return self.aperture_m / self.outer_scale_m

    @property
    def outer_scale_and_profile(self) -> tuple[float, tuple[float, ...]]:
        """D / L0 and the normalised profile of Cn2, as functions of `outer_scale` take them."""
        return self.aperture_over_outer_scale, self.normalised_profile

    @cached_property
    def blur_equivalent_d_over_r0(self) -> float:
        """D / r0 of the Kolmogorov turbulence that blurs as much, tilt removed."""
        strength = self.d_over_r0, *self.outer_scale_and_profile
        return short_exposure.blur_equivalent_d_over_r0(*strength)

    @property
    def rytov_variance(self) -> float:
        """Rytov variance of a spherical wave; above 0.3 scintillation, left out here, matters.

        2.25 k^(7/6) Int Cn2 [z (1 - z/L)]^(5/6) dz, 0.5 Cn2 k^(7/6) L^(11/6) for a constant Cn2
        (Andrews & Phillips, 2nd ed., ch. 8).
        """
        place, strength = self.integrated_cn2_by_slice
        weighted = strength * (place * (1 - place) * self.distance_m) ** (5 / 6)
        return 2.25 * self._k ** (7 / 6) * float(weighted.sum())

    def pixel_size_at_object_m(self, width_px: int) -> float:
        return self.scene_width_m / width_px

    def lambda_over_d_px(self, width_px: int) -> float:
        """The diffraction angle lambda / D in pixels: lambda f / (D p), p the pitch of a pixel."""
        pitch = self.focal_length_m * self.scene_width_m / (self.distance_m * width_px)
        return self.wavelength_m * self.focal_length_m / (self.aperture_m * pitch)

    def tilt_std_px(self, width_px: int) -> float:
        """Standard deviation of the Zernike tilt along one axis, in pixels.

        (2 / pi) (lambda / D) sqrt(0.4489 (D/r0)^(5/3)) f / p (Noll 1976; Tyler 1994), times what
        the outer scale leaves of it.
        """
        left = outer_scale.tilt_variance_over_kolmogorov(*self.outer_scale_and_profile)
        variance = TILT_VARIANCE * left
        spread = math.sqrt(variance) * self.d_over_r0 ** (5 / 6)
        return 2 / math.pi * self.lambda_over_d_px(width_px) * spread

    def tilt_and_blur_px(self, width_px: int) -> float:
        """How far turbulence spreads a point over time, along one axis, in pixels (rms): tilt and
        blur in quadrature."""
        return math.hypot(self.tilt_std_px(width_px), self.blur_px(width_px))

    def blur_px(self, width_px: int) -> float:
        """By how much turbulence blurs beyond diffraction, tilt removed, in pixels.

        The standard deviation along one axis of the Gaussian that holds half of its light within
        the same radius.
        """
        strength = self.d_over_r0, *self.outer_scale_and_profile
        blur = float(short_exposure.blur_std_in_lambda_over_d(*strength))
        return self.lambda_over_d_px(width_px) * blur

    def tilt_correlation_half_length_px(self, width_px: int) -> float:
        """The distance at which the correlation of the tilt falls to 1/2, in pixels."""
        reach_m = outer_scale.tilt_decay_distance(*self.outer_scale_and_profile) * self.aperture_m
        return reach_m / self.pixel_size_at_object_m(width_px)

    def with_d_over_r0(self, d_over_r0: float) -> "Atmosphere":
        """Return the same path and camera with Cn2 scaled to give `d_over_r0`."""
        check_option(0 <= d_over_r0 < math.inf, "atmosphere.d_over_r0", ">= 0", d_over_r0)
        if not self.d_over_r0:
            raise ValueError("atmosphere.cn2 must not be 0 throughout to be scaled")
        scale = (d_over_r0 / self.d_over_r0) ** (5 / 3)
        return replace(self, cn2=tuple(value * scale for value in self.cn2_profile))

    @property
    def _k(self) -> float:
        return 2 * math.pi / self.wavelength_m
