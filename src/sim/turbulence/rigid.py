"""Atmospheres drawn by camera and weather alone, lenses, distances and Cn2 independently.

What scintillates is rejected, which leaves large apertures over short paths: almost all of the tilt
then moves the whole view as one.  It was the prior up to version 0.1 and is kept for comparison.
"""

import math

import torch

from src.sim.turbulence.atmosphere import REFERENCE_PX, Atmosphere
from src.sim.turbulence.ranges import Range, between, choose_severity, log_between


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
    chosen = choose_severity(severity, generator)
    low, high = {"weak": (0.1, 1.5), "medium": (1.5, 4.0), "strong": (4.0, 10.0)}[chosen]
    for _ in range(64):
        u = torch.rand(4096, 6, generator=generator, dtype=torch.float64).numpy()
        length = between(u[:, 0], distance_m, "distance_m")
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
            alpha=float(between(u[i, 5], alpha, "alpha")),
        )
    raise ValueError(f"turbulence.atmosphere: no draw within its ranges is {chosen}")
