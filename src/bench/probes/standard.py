"""The bench: standard clips, one subject at a time, and what a probe finds."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from src.bench.candidates import Subject
from src.bench.probes.clips import Conditions, Stream, film
from src.metrics.image import aligned_psnr
from src.sim.pipeline import Pipeline

STANDARD = Conditions()


@dataclass(frozen=True)
class Finding:
    """What a probe found: `value` in `unit`, and how it went with what was varied.

    `curve`: (what was set, value) from easy to hard.  It is a failure beyond `limit`; `high`: the
    higher the better.
    """

    value: float
    unit: str
    limit: float
    curve: list[tuple[Any, float]] = field(default_factory=list)
    varied: str = ""
    high: bool = False

    def fails(self, value: float) -> bool:
        """Return whether `value` is beyond the limit; what is not a number is."""
        return not (value >= self.limit if self.high else value <= self.limit)

    @property
    def failed(self) -> bool:
        """Whether the value is beyond the limit."""
        return self.fails(self.value)

    @property
    def breaks_at(self) -> Any:
        """What was set where the limit is first exceeded; None: nowhere."""
        return next((setting for setting, value in self.curve if self.fails(value)), None)


class Bench:
    """Standard clips `numbers` of `pipeline`; frames of the first `warmup` windows do not count."""

    def __init__(self, pipeline: Pipeline, numbers: Sequence[int], warmup: int):
        self.pipeline, self.numbers, self.warmup = pipeline, numbers, warmup
        self._films: dict[str, list[Stream]] = {}
        self._standard: dict[str, float] = {}

    def streams(self, conditions: Conditions = STANDARD) -> list[Stream]:
        """Return the clips under `conditions`; each is simulated once."""
        name = repr(conditions)
        if name not in self._films:
            self._films[name] = [film(self.pipeline, n, conditions) for n in self.numbers]
        return self._films[name]

    def quality(self, subject: Subject, conditions: Conditions = STANDARD) -> float:
        """Return the aligned PSNR in dB at the clips' own rate, the mean over clips."""
        return self.over_clips(subject, self.streams(conditions), lambda x: x)

    def standard(self, subject: Subject) -> float:
        """Return `quality` of the standard clips, measured once for each subject."""
        if subject.name not in self._standard:
            self._standard[subject.name] = self.quality(subject)
        return self._standard[subject.name]

    def over_clips(self, subject: Subject, streams: Sequence[Stream], change: Any) -> float:
        """Return the mean aligned PSNR with every window (1, views, bins, h, w) put through
        `change`.
        """
        values = []
        for stream in streams:
            windows = map(change, stream.windows(stream.fps))
            frames, _ = subject.play(windows, stream.positions, 1 / stream.fps)
            values.append(self.score(frames, stream.target[1:]))
        return sum(values) / len(values)

    def losses(self, subject: Subject, settings: dict[Any, Conditions]) -> list[tuple[Any, float]]:
        """Return (setting, dB lost against the standard clips) for each."""
        base = self.standard(subject)
        return [(name, base - self.quality(subject, c)) for name, c in settings.items()]

    def score(self, frames: Tensor, target: Tensor) -> float:
        """Return the mean aligned PSNR of the frames that count."""
        return float(aligned_psnr(frames[self.warmup :], target[self.warmup :, None]).mean())


def worst(curve: list[tuple[Any, float]], *, limit: float, varied: str) -> Finding:
    """Return the finding whose value is the largest of the curve, in dB."""
    return Finding(max(value for _, value in curve), "dB", limit, curve, varied)
