"""Probes of the light field itself: views lost or out of place, a scene that is near."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from src.bench.candidates import Subject
from src.bench.probes.clips import Stream
from src.bench.probes.standard import Bench, Finding, worst
from src.metrics.image import aligned_psnr
from src.sim.optics import centre, layout


@dataclass(frozen=True)
class Lost:
    """Aligned PSNR lost when `counts` of the views are dark from the start, the worst of `draws`.

    A network that takes any number of views is given the others; one of a fixed number sees zeros.
    """

    counts: Sequence[int] = (1, 2, 4)
    draws: int = 4
    limit: float = 0.5

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the worst loss over `counts` and draws."""
        subject.needs_views(max(self.counts) + 1)
        base, rng, curve = bench.standard(subject), np.random.default_rng(0), []
        for count in self.counts:
            gone = [rng.permutation(subject.views)[:count].tolist() for _ in range(self.draws)]
            # A draw of this number that takes the centre view is among them.
            middle = centre(layout(subject.views))
            gone[0] = [middle, *(v for v in gone[0] if v != middle)][:count]
            losses = [base - _without(subject, bench, views) for views in gone]
            curve.append((count, max(losses)))
        return worst(curve, limit=self.limit, varied="views lost")


@dataclass(frozen=True)
class Misplaced:
    """Aligned PSNR lost when one view lies so many `pixels` beside its place."""

    pixels: Sequence[int] = (1, 2, 4)
    judged: int = 2
    limit: float = 0.3

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the loss at `judged` pixels."""
        subject.needs_views()
        base, curve = bench.standard(subject), []
        view = _neighbour(subject, bench.streams()[0])
        for shift in self.pixels:
            moved = partial(shifted, moves={view: (0, shift)})
            curve.append((shift, base - bench.over_clips(subject, bench.streams(), moved)))
        return Finding(dict(curve)[self.judged], "dB", self.limit, curve, "px out of place")


@dataclass(frozen=True)
class Parallax:
    """Aligned PSNR lost when the scene is nearer than the plane the views are registered for.

    `pixels`: disparity between neighbouring views.
    """

    pixels: Sequence[int] = (1, 2, 4)
    judged: int = 1
    limit: float = 1.0

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the loss at `judged` pixels a view."""
        subject.needs_views()
        places = bench.streams()[0].positions
        base, curve = bench.standard(subject), []
        for shift in self.pixels:
            moves = {i: (shift * row, shift * col) for i, (row, col) in enumerate(places)}
            nearer = partial(shifted, moves=moves)
            curve.append((shift, base - bench.over_clips(subject, bench.streams(), nearer)))
        return Finding(dict(curve)[self.judged], "dB", self.limit, curve, "px of disparity")


def shifted(voxels: Tensor, moves: dict[int, tuple[int, int]]) -> Tensor:
    """Return (n, views, bins, h, w) with view i moved by moves[i] (down, right) pixels; no events
    come in at the edges.
    """
    height, width = voxels.shape[-2:]
    moved = voxels.clone()
    for view, (down, right) in moves.items():
        moved[:, view] = 0
        to = (_span(down, height), _span(right, width))
        at = (_span(-down, height), _span(-right, width))
        moved[:, view, :, to[0], to[1]] = voxels[:, view, :, at[0], at[1]]
    return moved


def _span(shift: int, length: int) -> slice:
    return slice(max(shift, 0), length + min(shift, 0))


def _neighbour(subject: Subject, stream: Stream) -> int:
    """Return the index, in `stream`, of the view that comes before the centre one in the subject's
    layout (of the last one where the centre comes first).
    """
    places = layout(subject.views)
    return stream.positions.index(places[centre(places) - 1])


def _without(subject: Subject, bench: Bench, gone: list[int]) -> float:
    scores = []
    for stream in bench.streams():
        places, state, frames = list(layout(subject.views)), None, []
        kept = [i for i in range(subject.views) if i not in gone]
        for window in stream.windows(stream.fps):
            seen, _ = subject.choose(window, stream.positions)
            if subject.network.views is None:
                there, seen = [places[i] for i in kept], seen[:, kept]
            else:
                there, seen = places, seen.index_fill(1, torch.tensor(gone), 0.0)
            frame, state = subject.step(seen, state, there, 1 / stream.fps)
            frames.append(frame)
        scores.append(aligned_psnr(torch.cat(frames), stream.target[1:, None])[bench.warmup :])
    return float(torch.stack(scores).mean())
