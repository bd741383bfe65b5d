"""Probes of the simulator: stronger air, air that all views share, wind, flickering views."""

from collections.abc import Sequence
from dataclasses import dataclass

from src.bench.candidates import Subject
from src.bench.probes.clips import Conditions, simulated
from src.bench.probes.standard import Bench, Finding, worst


@dataclass(frozen=True)
class Strength:
    """Aligned PSNR lost from no turbulence to so large a `d_over_r0`."""

    d_over_r0: Sequence[float] = (1.0, 2.0, 4.0, 6.0, 10.0)
    limit: float = 2.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss against still air."""
        clear = bench.quality(subject, Conditions(d_over_r0=0.0))
        curve = [
            (ratio, clear - bench.quality(subject, Conditions(d_over_r0=ratio)))
            for ratio in self.d_over_r0
        ]
        return worst(curve, limit=self.limit, varied="D/r0")


@dataclass(frozen=True)
class SharedAir:
    """Aligned PSNR lost as the views look through more and more of the same air.

    `pitches`: distance between neighbouring sub-apertures in diameters of one; at 0 all views see
    the same and the light field has lost its cue.
    """

    pitches: Sequence[float] = (1.0, 0.5, 0.0)
    limit: float = 1.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss against independent air."""
        simulated(bench.pipeline.turbulence)
        aperture = bench.pipeline.draw(bench.numbers[0]).air.aperture_m
        settings = {
            pitch: Conditions(
                turbulence={"views_correlation": "baseline", "baseline_m": pitch * aperture}
            )
            for pitch in self.pitches
        }
        curve = bench.losses(subject, settings)
        return worst(curve, limit=self.limit, varied="diameters between views")


@dataclass(frozen=True)
class Wind:
    """Aligned PSNR lost as frozen turbulence is carried by stronger and stronger wind."""

    m_s: Sequence[float] = (1.0, 3.0, 10.0, 30.0)
    limit: float = 1.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss against the standard clips (no wind, decorrelating air)."""
        settings = {
            speed: Conditions(turbulence={"temporal": "flow", "wind_m_s": speed})
            for speed in self.m_s
        }
        return worst(bench.losses(subject, settings), limit=self.limit, varied="wind in m/s")


@dataclass(frozen=True)
class Gain:
    """Aligned PSNR lost as each view's brightness flickers by itself, as scintillation makes it."""

    spreads: Sequence[float] = (0.02, 0.05, 0.1)
    limit: float = 1.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss over `spreads`, standard deviations of log brightness."""
        settings = {spread: Conditions(gain=spread) for spread in self.spreads}
        return worst(bench.losses(subject, settings), limit=self.limit, varied="spread of log gain")
