"""Probes of numbers: growth of a small difference, the worst input, bf16, chunks."""

import math
from copy import deepcopy
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Any

import torch
from torch import Tensor

from src.bench.candidates import Subject
from src.bench.probes.clips import Stream
from src.bench.probes.standard import Bench, Finding
from src.metrics.image import aligned_psnr
from src.models.fast import running
from src.models.look_ahead import reversed_grid
from src.models.unroll import accepted
from src.sim import noise


@dataclass(frozen=True)
class Growth:
    """Growth exponent, per window, of a small difference in one window of the input.

    Fitted to the logarithm of the rms difference of the frames; above 0 the difference grows.
    """

    size: float = 1e-3
    skip: int = 3
    limit: float = 0.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the mean exponent over clips."""
        slopes = [self._slope(subject, stream) for stream in bench.streams()]
        return Finding(sum(slopes) / len(slopes), "per window", self.limit)

    def _slope(self, subject: Subject, stream: Stream) -> float:
        shown = list(stream.windows(stream.fps))
        start = len(shown) // 3
        key = noise.key("probes", "growth")
        drawn = noise.normal(key, torch.arange(shown[0].numel())).view_as(shown[0])
        # Where there were events anyway, so that no pixel wakes that slept.
        nudged = shown[start] + self.size * drawn * (shown[start] != 0)
        plain, _ = subject.play(shown, stream.positions, 1 / stream.fps)
        changed = [*shown[:start], nudged, *shown[start + 1 :]]
        other, _ = subject.play(changed, stream.positions, 1 / stream.fps)
        difference = (plain - other)[start + self.skip :].double().square().mean((1, 2, 3)).sqrt()
        logs = difference.clamp(min=1e-12).log()
        times = torch.arange(len(logs), dtype=torch.float64) - (len(logs) - 1) / 2
        return float((times * logs).sum() / times.square().sum())


@dataclass(frozen=True)
class WorstInput:
    """Gain of an input found by ascent: rms change of the last frame over rms of the input.

    The input is added to the first of `windows` windows (Tanay et al., arXiv 2010.05099); `steps`
    of ascent, its rms held at `size`.
    """

    windows: int = 12
    steps: int = 8
    size: float = 0.02
    limit: float = 1.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the largest gain met."""
        if not any(p.is_floating_point() for p in subject.network.parameters()):
            raise ValueError("it has no parameters, and its answer is linear")
        stream = bench.streams()[0]
        shown = list(islice(stream.windows(stream.fps), bench.warmup + self.windows))
        _, state = subject.play(shown[: bench.warmup], stream.positions, 1 / stream.fps)
        chosen = [subject.choose(window, stream.positions) for window in shown[bench.warmup :]]
        plain = self._last(subject, chosen, state, torch.zeros(()), stream)
        key = noise.key("probes", "worst")
        extra = noise.normal(key, torch.arange(chosen[0][0].numel())).view_as(chosen[0][0])
        curve = []
        for step in range(self.steps):
            extra = (extra * self.size / extra.square().mean().sqrt()).detach().requires_grad_()
            last = self._last(subject, chosen, state, extra, stream)
            change = (last - plain).square().mean()
            (extra_slope,) = torch.autograd.grad(change, extra)
            curve.append((step, math.sqrt(float(change.detach())) / self.size))
            extra = extra_slope + 1e-12
        return Finding(max(gain for _, gain in curve), "x", self.limit, curve, "steps of ascent")

    def _last(
        self, subject: Subject, chosen: list, state: Any, extra: Tensor, stream: Stream
    ) -> Tensor:
        for k, (window, places) in enumerate(chosen):
            options = accepted(subject.network, window_s=1 / stream.fps, positions=places)
            frame, state = subject.network(window + extra if k == 0 else window, state, **options)
        return frame


@dataclass(frozen=True)
class Bf16:
    """Largest mean difference of aligned PSNR, in dB, of bf16 to float32, over a long run."""

    windows: int = 1000
    limit: float = 0.1

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the absolute difference over the last quarter."""
        if not any(True for _ in subject.network.parameters()):
            raise ValueError("it has no parameters to round")
        stream = bench.streams()[0]
        exact = self._scores(subject, stream)
        half = running(subject.network, "bf16")
        rounded = self._scores(Subject(subject.name, half, subject.views), stream)
        gaps = (exact - rounded).view(4, -1).mean(1).abs().tolist()
        quarter = self.windows // 4
        curve = [(quarter * (k + 1), gap) for k, gap in enumerate(gaps)]
        return Finding(gaps[-1], "dB", self.limit, curve, "windows")

    def _scores(self, subject: Subject, stream: Stream) -> Tensor:
        forth = list(stream.windows(stream.fps))
        back = [reversed_grid(window) for window in reversed(forth)]
        truth = torch.cat([stream.target[1:], stream.target[:-1].flip(0)])
        shown = islice(cycle(forth + back), self.windows // 4 * 4)
        frames, _ = subject.play(shown, stream.positions, 1 / stream.fps)
        places = torch.arange(len(frames)) % len(truth)
        return aligned_psnr(frames, truth[places, None])


@dataclass(frozen=True)
class Chunked:
    """Largest difference of a frame between one run and a run in chunks with the state carried."""

    chunk: int = 7
    limit: float = 0.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the largest absolute difference."""
        stream = bench.streams()[0]
        shown = list(stream.windows(stream.fps))
        whole, _ = subject.play(shown, stream.positions, 1 / stream.fps)
        parts, state = [], None
        for start in range(0, len(shown), self.chunk):
            chunk, own = shown[start : start + self.chunk], deepcopy(state)
            part, state = subject.play(chunk, stream.positions, 1 / stream.fps, own)
            parts.append(part)
        gap = float((whole - torch.cat(parts)).abs().max())
        return Finding(gap, "grey", self.limit)
