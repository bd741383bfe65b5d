"""Probes of memory: holding a picture, running long, starting up, recovering from a shock."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, cycle, islice

import torch
from jaxtyping import Float
from torch import Tensor

from src.bench.candidates import Subject
from src.bench.probes.clips import Conditions, Stream
from src.bench.probes.standard import Bench, Finding
from src.metrics.image import aligned_psnr
from src.metrics.temporal import wobble
from src.models.look_ahead import reversed_grid

LOOP_SCORED = 4  # every so manyth window of a long run is scored


@dataclass(frozen=True)
class Hold:
    """Contrast kept, in %, after so many `windows` without an event."""

    windows: Sequence[int] = (10, 50, 100, 300, 1000)
    limit: float = 90.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the contrast after the last of `windows`."""
        curves = [self._kept(subject, stream) for stream in bench.streams()]
        kept = torch.tensor(curves).mean(0).tolist()
        curve = list(zip(self.windows, kept, strict=True))
        return Finding(kept[-1], "%", self.limit, curve, "empty windows", high=True)

    def _kept(self, subject: Subject, stream: Stream) -> list[float]:
        shown = list(stream.windows(stream.fps))
        frames, state = subject.play(shown, stream.positions, 1 / stream.fps)
        before = float(frames[-1].std())
        kept, done = [], 0
        for count in self.windows:
            empty = [torch.zeros_like(shown[0])] * (count - done)
            frames, state = subject.play(empty, stream.positions, 1 / stream.fps, state)
            kept.append(100 * float(frames[-1].std()) / max(before, 1e-9))
            done = count
        return kept


@dataclass(frozen=True)
class LongRun:
    """Aligned PSNR lost between the second and the last loop of a clip played to and fro."""

    windows: int = 5000
    limit: float = 1.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the loss in dB; the curve has one entry a tenth of the run."""
        stream = bench.streams()[0]
        forth = list(stream.windows(stream.fps))
        back = [reversed_grid(window) for window in reversed(forth)]
        truth = torch.cat([stream.target[1:], stream.target[:-1].flip(0)])
        loop, length = forth + back, 2 * len(forth)
        if self.windows < 3 * length:
            raise ValueError(f"probes.long_run.windows must be >= {3 * length}, got {self.windows}")
        scores = self._scores(subject, stream, loop, truth)
        per_loop = scores[: self.windows // length * length].view(-1, length).nanmean(1)
        losses = (per_loop[1] - per_loop[1:]).tolist()
        curve = [(length * (k + 2), loss) for k, loss in enumerate(losses)]
        step = max(1, len(curve) // 10)
        thinned = [*curve[:-1:step], curve[-1]]
        return Finding(losses[-1], "dB", self.limit, thinned, "windows")

    def _scores(
        self, subject: Subject, stream: Stream, loop: list[Tensor], truth: Tensor
    ) -> Float[Tensor, " windows"]:
        scores, state = torch.full((self.windows,), torch.nan), None
        for k, window in enumerate(islice(cycle(loop), self.windows)):
            frames, state = subject.play([window], stream.positions, 1 / stream.fps, state)
            if k % LOOP_SCORED == 0:
                scores[k] = aligned_psnr(frames, truth[k % len(loop)][None, None])[0]
        return scores


@dataclass(frozen=True)
class StartUp:
    """Windows until the picture is within `within` dB of the clip's second half, for good."""

    within: float = 1.0
    limit: float = 20.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the mean over clips; a clip that never gets there counts its length."""
        waits = []
        for stream in bench.streams():
            frames, _ = subject.play(stream.windows(stream.fps), stream.positions, 1 / stream.fps)
            scores = aligned_psnr(frames, stream.target[1:, None])
            waits.append(settled(scores, self.within))
        return Finding(sum(waits) / len(waits), "windows", self.limit)


@dataclass(frozen=True)
class Shock:
    """Windows until the picture is back within `within` dB after `length` windows of flicker."""

    length: int = 10
    events: float = 3.0
    within: float = 1.0
    limit: float = 20.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Flicker: every pixel makes `events` ON events in a window, as many OFF in the next."""
        waits = [self._wait(subject, stream) for stream in bench.streams()]
        return Finding(sum(waits) / len(waits), "windows", self.limit)

    def _wait(self, subject: Subject, stream: Stream) -> float:
        shown = list(stream.windows(stream.fps))
        half = len(shown) // 2
        flash = torch.full_like(shown[0], self.events / shown[0].shape[2])
        flashes = [(-1) ** k * flash for k in range(self.length)]
        calm, _ = subject.play(shown, stream.positions, 1 / stream.fps)
        flickering = chain(shown[:half], flashes, shown[half:])
        shaken, _ = subject.play(flickering, stream.positions, 1 / stream.fps)
        truth = stream.target[1 + half :, None]
        lost = aligned_psnr(calm[half:], truth) - aligned_psnr(shaken[half + self.length :], truth)
        return last_beyond(lost, self.within)


@dataclass(frozen=True)
class Still:
    """Wobble of a still scene's picture as a share, in %, of what the air does to one view.

    `moves`: the share of the clip in which the scene moves before it stands; at 0 its events are
    all turbulence.  Fails where it would be calmer to look at the scene through one view.
    """

    limit: float = 100.0
    moves: float = 0.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the share; the change of block positions is that of `metrics.temporal.wobble`."""
        shares = []
        for stream in bench.streams(Conditions(moves=self.moves)):
            frames, _ = subject.play(stream.windows(stream.fps), stream.positions, 1 / stream.fps)
            truth = stream.target[1:, None]
            since = int(self.moves * len(truth)) + bench.warmup
            if since > len(truth) - 2:
                raise ValueError(f"data.test_windows must be > {since + 1}, got {len(truth)}")
            through = wobble(stream.turbulent[1:, None].clone(), truth)[since:].mean()
            ours = wobble(frames, truth)[since:].mean()
            shares.append(100 * float(ours / through.clamp(min=1e-9)))
        return Finding(sum(shares) / len(shares), "%", self.limit)


def settled(scores: Float[Tensor, " windows"], within: float) -> float:
    """Return the first window from which on the scores, averaged over five windows, stay within
    `within` of the mean of their second half.
    """
    plateau = scores[len(scores) // 2 :].mean()
    smooth = scores.unfold(0, 5, 1).mean(1) if len(scores) >= 5 else scores
    return last_beyond(plateau - smooth[: len(scores) // 2], within)


def last_beyond(lost: Float[Tensor, " windows"], within: float) -> float:
    """Return how many windows pass until `lost` is above `within` for the last time."""
    beyond = (lost > within).nonzero()
    return float(beyond[-1] + 1) if len(beyond) else 0.0
