"""Filling a pre-simulated turbulence cache fast: one device, and processes that keep it busy.

The processes draw clips and, for a GPU, prepare their turbulence; this one computes the pixels of
all views.  Each process has a pipe of its own: in one that they share, as that of a DataLoader, a
process that is killed while it writes a clip lets the reader wait for ever.
"""

import multiprocessing
import os
import pickle
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from src import add_package_prefix
from src.sim.pipeline import ClipParameters, Pipeline, crop_frames
from src.sim.turbulence import Turbulence
from src.sim.turbulence.clip_plan import TilePlan
from src.sim.turbulence.clip_rendering import render_tilt, render_views
from src.sim.turbulence.contract import Crop
from src.sim.turbulence.engines.device import copy_to_device
from src.training.clip_cache import CachedClip, clip_metadata
from src.training.worker_process import prepare_worker_process

MAX_QUEUED_CLIPS = 2  # on the device

DrawnClip = tuple[ClipParameters, dict[str, Any]]


@dataclass(frozen=True)
class FillReport:
    """`clips`: how many were made, the first ones without a gap; `seconds` it took, of which
    `waiting_s` for clips to be drawn.
    """

    clips: int
    seconds: float
    waiting_s: float

    @property
    def clips_per_second(self) -> float:
        """Clips a second, the start of the processes included."""
        return self.clips / max(self.seconds, 1e-9)

    def __str__(self) -> str:
        return (
            f"{self.clips} clips in {self.seconds:.1f} s, {self.clips_per_second:.1f} a second; "
            f"{self.waiting_s:.1f} s of it waiting for clips to be drawn"
        )


class SimulatedClips(Iterator[tuple[int, CachedClip]]):
    """The clips `indices` of `source` with their numbers, in order, simulated on `device`.

    `workers`: the processes that draw, until `close`; 0: this one.  `waiting_s`: the seconds that
    this one has waited for draws.  Raises ValueError for a clip that is refused, RuntimeError for
    one that fails, both naming the clip, and RuntimeError where a process died.
    """

    def __init__(
        self, source: Pipeline, indices: Sequence[int], *, device: torch.device | str, workers: int
    ):
        if type(workers) is not int or workers < 0:
            raise ValueError(f"workers must be a whole number >= 0, got {workers}")
        self.source, self.device, self.waiting_s = source, torch.device(device), 0.0
        self._drawn = _draw_clips(source, indices, min(workers, len(indices)), self.device)
        self._queued = deque[torch.cuda.Event]()

    def __next__(self) -> tuple[int, CachedClip]:
        while len(self._queued) > MAX_QUEUED_CLIPS:
            self._queued.popleft().synchronize()
        start = time.monotonic()
        index, draw, metadata = next(self._drawn)
        self.waiting_s += time.monotonic() - start
        frames = _simulate_drawn(self.source, index, draw, self.device)
        if self.device.type == "cuda":
            self._queued.append(torch.cuda.Event())
            self._queued[-1].record()
        return index, CachedClip(*frames, metadata)

    def synchronize(self) -> None:
        """Wait until the device is done with the clips so far."""
        if self._queued:
            self._queued[-1].synchronize()

    def close(self) -> None:
        """End the processes that draw."""
        self._drawn.close()


def store_clips(
    clips: SimulatedClips,
    store: Callable[[int, CachedClip], None],
    *,
    count: int | None = None,
    until: float | None = None,
) -> FillReport:
    """Store the next `count` of `clips` (None: all), until the time `until` of time.monotonic; a
    clip that is ready later is dropped, but for the first.
    """
    start, waited, stored = time.monotonic(), clips.waiting_s, 0
    while count is None or stored < count:
        if (clip := next(clips, None)) is None:
            break
        if stored and until is not None and time.monotonic() >= until:
            break
        store(*clip)
        stored += 1
    clips.synchronize()
    return FillReport(stored, time.monotonic() - start, clips.waiting_s - waited)


def fill(
    source: Pipeline,
    indices: Iterable[int],
    store: Callable[[int, CachedClip], None],
    *,
    device: torch.device | str,
    workers: int,
    until: float | None = None,
) -> FillReport:
    """Simulate the clips `indices` on `device` and `store` them in order, see SimulatedClips and
    store_clips; raises what they do, and what `store` raises.
    """
    clips = SimulatedClips(source, list(indices), device=device, workers=workers)
    try:
        return store_clips(clips, store, until=until)
    finally:
        clips.close()


@dataclass(frozen=True)
class _ClipSource:
    """Draws clips with their metadata and, if `prepare`, their turbulence prepared."""

    source: Pipeline
    prepare: bool

    def draw(self, index: int) -> DrawnClip:
        """Return one clip; ValueError for one that is refused, else RuntimeError, naming it."""
        try:
            return self._draw(index)
        except Exception as error:
            kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
            message = f"clip {index}: {kind}{error}"
            raise (RuntimeError if kind else ValueError)(message) from error

    def _draw(self, index: int) -> DrawnClip:
        draw = self.source.draw(index)
        metadata = clip_metadata(self.source, draw)
        turbulence = self.source.turbulence_operator(draw) if self.prepare else None
        if isinstance(turbulence, Turbulence) and not turbulence.is_identity:
            frames, generator = len(draw.clip.frames), self.source.turbulence_generator(draw)
            prepared = prepare_turbulence(turbulence, frames, generator, draw.crop)
            draw = replace(draw, turbulence=prepared)
        return draw, metadata


@dataclass(frozen=True)
class PreparedTurbulence:
    """The turbulence of one clip in `crop`, drawn and ready for a device: an operator (contract.py)
    that can be pickled.
    """

    metadata: Mapping[str, float | int | str]
    crop: Crop
    plans: Sequence[TilePlan]

    @torch.no_grad()
    def degrade(
        self,
        frames: Float[Tensor, "one frames h w"],
        generator: torch.Generator,
        *,
        crop: Crop | None = None,
    ) -> Float[Tensor, "one views frames hc wc"]:
        """Return every view; raises ValueError for another crop or more clips than prepared."""
        if (len(frames), crop) != (1, self.crop):
            raise ValueError(
                f"prepared turbulence is of 1 clip in {self.crop}, got {len(frames)} in {crop}"
            )
        return render_views(frames[0].float(), self.plans)[None]

    @torch.no_grad()
    def tilt(
        self, frames: int, generator: torch.Generator, *, crop: Crop | None = None
    ) -> Float[Tensor, "views frames 2 hc wc"]:
        """Return the displacement (x, y) in pixels, in the crop that was prepared."""
        return render_tilt(self.plans, frames)


def prepare_turbulence(
    turbulence: Turbulence, frames: int, generator: torch.Generator, crop: Crop
) -> PreparedTurbulence:
    """Return the turbulence of one clip of so many `frames`, drawn for `crop` on the CPU."""
    metadata = turbulence.clip_metadata(generator.clone_state())
    return PreparedTurbulence(metadata, crop, turbulence.plan(frames, generator, crop))


def prepares_turbulence(device: torch.device) -> bool:
    """Return whether turbulence is prepared for a device; a CPU computes view by view."""
    return device.type != "cpu"


def _draw_clips(
    source: Pipeline, indices: Sequence[int], workers: int, device: torch.device
) -> Generator[tuple[int, ClipParameters, dict[str, Any]]]:
    """Yield clips in order with draw and metadata; the `workers` processes that draw them in turn
    end with the generator.
    """
    clips = _ClipSource(source, prepares_turbulence(device))
    drawing: list[_DrawingProcess] = []
    with ExitStack() as at_end:
        for worker in range(workers):
            drawing.append(_DrawingProcess(clips, indices[worker::workers]))
            at_end.callback(drawing[-1].stop)
        for place, index in enumerate(indices):
            draw = drawing[place % workers].receive if workers else clips.draw
            yield index, *draw(index)


class _DrawingProcess:
    """A process that draws the clips `indices` and sends them, one ahead of what was received.

    Raises RuntimeError where it cannot be started.
    """

    def __init__(self, clips: _ClipSource, indices: Sequence[int]):
        context = _forkserver()
        self.receiver, sender = context.Pipe(duplex=False)
        arguments = (clips, indices, sender)
        self.process: BaseProcess = context.Process(target=_send_clips, args=arguments, daemon=True)
        try:
            self.process.start()
        except (EOFError, OSError) as error:  # their server died
            raise RuntimeError(f"a process that draws cannot be started: {error!r}") from error
        sender.close()  # now the process alone holds it, so that the pipe ends with it

    def receive(self, index: int) -> DrawnClip:
        """Return the next clip, of number `index`; raises what `draw` does, and RuntimeError where
        the process died.
        """
        try:
            drawn = pickle.loads(self.receiver.recv_bytes())
        except (EOFError, OSError) as error:
            self.process.join()
            ending = f"a process that draws ended with exit code {self.process.exitcode}"
            raise RuntimeError(f"waiting for clip {index}: {ending}") from error
        if isinstance(drawn, Exception):
            raise drawn
        return drawn

    def stop(self) -> None:
        """End the process, whatever it is doing."""
        self.process.kill()
        self.process.join()
        self.receiver.close()


def _send_clips(clips: _ClipSource, indices: Sequence[int], sender: Connection) -> None:
    prepare_worker_process()
    os.environ["CUDA_VISIBLE_DEVICES"] = ""  # the device is for the process that asks
    cv2.setNumThreads(1)
    for index in indices:
        try:
            drawn: DrawnClip | Exception = clips.draw(index)
        except Exception as error:
            drawn = error
        # PyTorch would send tensors through /dev/shm, which is small in containers
        sender.send_bytes(pickle.dumps(drawn, pickle.HIGHEST_PROTOCOL))


def _forkserver() -> multiprocessing.context.ForkServerContext:
    """Return a context whose processes are forks of one that has imported what they need, once: a
    fork of this process would take CUDA along, and new ones would all import at the same time.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, add_package_prefix("src.app.simulation")])
    return context


def _simulate_drawn(
    source: Pipeline, index: int, draw: ClipParameters, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return views and clean frames of a drawn clip, float16; CUDA may not be done with them.

    Raises RuntimeError, naming the clip, for whatever goes wrong.
    """
    try:
        frames = copy_to_device(draw.clip.frames, device)
        draw = replace(draw, clip=replace(draw.clip, frames=frames))
        views = source.render_views([draw], device)[0].half().contiguous()
        return views, crop_frames(frames, draw.crop).half().contiguous()
    except Exception as error:
        raise RuntimeError(f"clip {index}: {type(error).__name__}: {error}") from error
