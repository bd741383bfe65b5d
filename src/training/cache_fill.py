"""Filling a pre-simulated turbulence cache fast: one device, and processes that keep it busy.

The processes draw clips and prepare their air (cache_drawing.py); this one computes the pixels of
all views and hands them on.  Process k of n draws the clips k, k + n, ... of those asked for, some
ahead, and they are taken in order.
"""

import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from src.sim.pipeline import Pipeline
from src.training.cache_drawing import SLOTS, Drawn, drawers

BEHIND = 2  # clips that the device may be behind

Keep = Callable[[int, Tensor, Tensor, dict[str, Any]], None]


@dataclass(frozen=True)
class FillReport:
    """`clips`: how many of those asked for were made, the first ones without a gap; `seconds` it
    took; `stages`: shares of that time: `waiting` for a clip to be drawn, `simulating` it (on a
    device: launching), waiting for the `device` and `keeping` it; beside them `drawing`, the share
    of the other processes' time in which they drew these clips.
    """

    clips: int
    seconds: float
    stages: dict[str, float] = field(default_factory=dict)

    @property
    def clips_per_second(self) -> float:
        """Clips a second, the start of the processes included."""
        return self.clips / max(self.seconds, 1e-9)

    def __str__(self) -> str:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in self.stages.items())
        speed = f"{self.clips_per_second:.1f} a second"
        return f"{self.clips} clips in {self.seconds:.1f} s, {speed}: {shares}"


def fill(
    source: Pipeline,
    indices: Iterable[int],
    keep: Keep,
    *,
    device: torch.device | str,
    workers: int,
    until: float | None = None,
) -> FillReport:
    """Simulate the clips `indices` on `device` in order, until the time `until` of time.monotonic.

    `keep(index, views, clean, facts)` gets each: `views` (views, frames, h, w), light, and `clean`
    (frames, h, w), code values, float16 on the device; `facts`: name, fps, the record of its air.
    `workers`: the processes that draw.  Raises ValueError for a clip that is refused, RuntimeError
    for one that fails or whose process died, both naming the clip, and what `keep` raises.
    """
    indices, device = list(indices), torch.device(device)
    if type(workers) is not int or workers < 1:
        raise ValueError(f"workers must be a whole number >= 1, got {workers}")
    if not indices:
        return FillReport(0, 0.0)
    count, laps = min(workers, len(indices)), _Laps()
    with drawers(source, [indices[k::count] for k in range(count)], ahead=prepares(device)) as some:
        pixels, made, drawing = _Pixels(source, device), 0, 0.0
        for index in indices:
            drawer = some[made % count]
            drawn = drawer.take(index, until)
            laps("waiting")
            if drawn is None:
                break
            frames = drawer.frames(drawn, device, more=made + SLOTS * count < len(indices))
            views, clean = pixels(index, drawn, frames)
            laps("simulating")
            pixels.catch_up(BEHIND)
            laps("device")
            keep(index, views, clean, drawn.facts)
            laps("keeping")
            made, drawing = made + 1, drawing + drawn.seconds
        pixels.catch_up(0)
        laps("device")
    seconds = sum(laps.spent.values())
    stages = {name: spent / max(seconds, 1e-9) for name, spent in laps.spent.items()}
    return FillReport(made, seconds, stages | {"drawing": drawing / max(seconds, 1e-9) / count})


def prepares(device: torch.device) -> bool:
    """Return whether those who draw prepare the air for a device; a CPU computes view by view."""
    return device.type != "cpu"


class _Laps:
    """How long each stage took."""

    def __init__(self):
        self.spent, self.last = defaultdict(float), time.monotonic()

    def __call__(self, stage: str) -> None:
        """End a lap of `stage`."""
        now = time.monotonic()
        self.spent[stage] += now - self.last
        self.last = now


class _Pixels:
    """The pixels of drawn clips on a device."""

    def __init__(self, source: Pipeline, device: torch.device):
        self.device, self.source, self.ahead = device, source, copy(source)
        self.ahead.turbulence = _Ahead()
        self.ends: deque[torch.cuda.Event] = deque()

    def __call__(self, index: int, drawn: Drawn, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Return what the views see and the clean clip, float16; CUDA may not be done with them.

        Raises RuntimeError, naming the clip, for whatever goes wrong.
        """
        draw = replace(drawn.draw, clip=replace(drawn.draw.clip, frames=frames))
        top, left, height, width = draw.crop
        source = self.ahead if drawn.ahead else self.source
        try:
            views = source.views(draw, self.device)[0].half().contiguous()
            clean = frames[:, top : top + height, left : left + width].half().contiguous()
        except Exception as error:
            raise RuntimeError(f"clip {index}: {type(error).__name__}: {error}") from error
        if self.device.type == "cuda":
            self.ends.append(torch.cuda.Event())
            self.ends[-1].record()
        return views, clean

    def catch_up(self, behind: int) -> None:
        """Wait until the device is at most so many clips behind."""
        while len(self.ends) > behind:
            self.ends.popleft().synchronize()


class _Ahead:
    """The turbulence model (model.py) of clips whose draws are their air itself."""

    def operator(self, drawn: Any, **_: Any) -> Any:
        """Return the air that was drawn."""
        return drawn
