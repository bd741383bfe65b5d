"""Probes of time and rate: other window lengths, thresholds, fewer events, noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from src.bench.candidates import Subject
from src.bench.probes.clips import Conditions, Stream
from src.bench.probes.standard import Bench, Finding, worst
from src.metrics.image import aligned_psnr
from src.sim import noise


@dataclass(frozen=True)
class Rates:
    """Aligned PSNR lost, at the same instants, when the events are cut at another rate.

    `rates`: windows a second, easy to hard; each is a multiple or a whole part of the clip's own.
    `seconds`: how much of the clip is played.
    """

    rates: Sequence[float] = (60.0, 240.0, 600.0, 1200.0)
    seconds: float = 0.3
    limit: float = 1.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss over `rates`."""
        totals = torch.zeros(len(self.rates))
        for stream in bench.streams():
            own = self._score(subject, stream, stream.fps)
            totals += torch.tensor([own - self._score(subject, stream, r) for r in self.rates])
        curve = list(zip(self.rates, (totals / len(bench.streams())).tolist(), strict=True))
        return worst(curve, limit=self.limit, varied="windows a second")

    def _score(self, subject: Subject, stream: Stream, rate: float) -> float:
        """Score the second half, at the instants that all rates share."""
        windows = stream.windows(rate, self.seconds)
        frames, _ = subject.play(windows, stream.positions, 1 / rate)
        slowest = min(stream.fps, *self.rates)
        count = int(min(self.seconds, stream.seconds) * slowest)
        if count < 2:
            raise ValueError(f"probes: {count} instants at {slowest} a second are too few")
        instants = torch.arange(count // 2, count) + 1
        at = (instants * (rate / slowest)).round().long() - 1
        truth = (instants * (stream.fps / slowest)).round().long()
        return float(aligned_psnr(frames[at], stream.target[truth, None]).mean())


@dataclass(frozen=True)
class Thresholds:
    """Aligned PSNR lost at other contrast thresholds of the sensor."""

    thresholds: Sequence[float] = (0.1, 0.3, 0.5, 0.7)
    limit: float = 2.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss over `thresholds`."""
        settings = {c: Conditions(sensor={"threshold": c}) for c in self.thresholds}
        return worst(bench.losses(subject, settings), limit=self.limit, varied="threshold C")


@dataclass(frozen=True)
class FewerEvents:
    """Aligned PSNR lost when only a share of the entries of the grids is kept, at random."""

    shares: Sequence[float] = (0.5, 0.25, 0.1)
    limit: float = 2.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the loss at the smallest of `shares`."""
        base, curve = bench.standard(subject), []
        for share in self.shares:
            drawn = noise.generator(noise.key("probes", "share", str(share)))

            def thinned(voxels: Tensor, share: float = share, drawn=drawn) -> Tensor:
                return voxels * (torch.rand(voxels.shape, generator=drawn) < share)

            curve.append((share, base - bench.over_clips(subject, bench.streams(), thinned)))
        return Finding(curve[-1][1], "dB", self.limit, curve, "share of events kept")


@dataclass(frozen=True)
class SensorNoise:
    """Aligned PSNR lost under another sensor: `name` of an argument of EventSensor, its `values`.

    `also`: other arguments that are set with it.
    """

    name: str
    values: Sequence[float | str]
    also: dict | None = None
    limit: float = 2.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss over `values`."""
        settings = {
            value: Conditions(sensor={self.name: value} | (self.also or {}))
            for value in self.values
        }
        curve = bench.losses(subject, settings)
        return worst(curve, limit=self.limit, varied=f"sensor.{self.name}")
