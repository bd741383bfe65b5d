"""Probe of fast motion: whether what flies straight is drawn so."""

from dataclasses import dataclass
from statistics import mean

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from src.bench.candidates import Subject
from src.bench.probes.clips import Conditions, Stream
from src.bench.probes.standard import Bench, Finding
from src.metrics.temporal import straightness

LAG = 6  # frames over which brightening is looked at
GATE = 24.0  # pixels around the true front that are looked at
MARGIN = 12.0  # pixels from the frame's border within which the true front does not count
STARTS = 32  # frames that do not count: until a thing has left where it stood, which no event tells


@dataclass(frozen=True)
class Flight:
    """How far the front of what flies strays from its line, across it, in pixels, rms.

    The front is the centroid of what has become brighter in the last frames near where it truly is,
    so that a trail which stays does not count; a constant offset does not either.
    """

    limit: float = 0.3

    def __call__(self, subject: Subject, bench: Bench) -> Finding:
        """Return the mean over clips of one thing that flies.

        The curve begins with two means that say what to hold it against, the network's without
        turbulence and that of one view of the light itself, and goes on with every clip.
        """
        streams = bench.streams()
        still = mean(_stray(subject, s) for s in bench.streams(Conditions(d_over_r0=0.0)))
        light = mean(across(s.turbulent[1:], s.target[1:]) for s in streams)
        strays = [_stray(subject, stream) for stream in streams]
        clips = [(f"clip {n}", stray) for n, stray in zip(bench.numbers, strays, strict=True)]
        curve = [("no turbulence", still), ("light of one view", light), *clips]
        return Finding(mean(strays), "px", self.limit, curve, "what is looked at")


def _stray(subject: Subject, stream: Stream) -> float:
    frames, _ = subject.play(stream.windows(stream.fps), stream.positions, 1 / stream.fps)
    return across(frames[:, 0], stream.target[1:])


def across(frames: Float[Tensor, "frames h w"], truth: Float[Tensor, "frames h w"]) -> float:
    """Return the rms distance, in pixels, of the front in `frames` from its line in `truth`.

    Raises ValueError for fewer than four frames that count.
    """
    risen, true = ((film[LAG:] - film[:-LAG]).clamp(min=0) for film in (frames, truth))
    known = _centroid(true)
    counts = _inside(known, truth.shape[1:])
    counts[:STARTS] = False
    if counts.sum() < 4:
        raise ValueError(f"data.test_windows must show more of a flight, got {counts.sum()} frames")
    known, risen = known[counts], risen[counts]
    y, x = torch.meshgrid(*map(torch.arange, risen.shape[1:]), indexing="ij")
    near = torch.hypot(x - known[:, 0, None, None], y - known[:, 1, None, None]) < GATE
    risen = risen * near
    found = _centroid((risen - risen.amax((1, 2), keepdim=True) / 3).clamp(min=0))
    along = known[-1] - known[0]
    normal = torch.stack([-along[1], along[0]]) / along.norm()
    return straightness((found @ normal)[:, None], (known @ normal)[:, None])


def _centroid(weight: Float[Tensor, "frames h w"]) -> Float[Tensor, "frames 2"]:
    """Return the centres (x, y); NaN of a frame of zeros."""
    rows, columns = (torch.arange(side).to(weight) for side in weight.shape[1:])
    sums = torch.stack([weight.sum(1) @ columns, weight.sum(2) @ rows], 1)
    return sums / weight.sum((1, 2))[:, None]


def _inside(place: Float[Tensor, "frames 2"], size: torch.Size) -> Bool[Tensor, " frames"]:
    """Return where a place (x, y) lies well within a frame of `size` (h, w)."""
    most = torch.tensor([size[1] - 1.0, size[0] - 1.0]) - MARGIN
    return ((place > MARGIN) & (place < most)).all(1)
