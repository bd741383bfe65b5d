"""Processes that draw clips for one that computes their pixels (cache_fill.py).

Scenes are rendered on the CPU and so is a clip's air prepared, there.  Frames come through shared
memory without a name (Linux), gone with the processes, the rest of a clip, two megabytes at most,
through a pipe.
"""

import mmap
import multiprocessing
import os
import pickle
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import recv_handle, send_handle
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from src.sim.pipeline import Draw, Pipeline
from src.sim.turbulence.engines.device import moved
from src.sim.turbulence.model import PreparedAir

SLOTS = 2  # clips that a process is ahead
PATIENCE = 0.2  # seconds between two looks at the clock


@dataclass(frozen=True)
class Drawn:
    """A drawn clip on its way: the draw but for its frames, which are (`shape`) in slot `slot`, new
    memory for which follows if `fresh`; `facts`: name, fps and the record of its air; `ahead`:
    whether `draw.air` is the prepared air itself; how many `seconds` it took.
    """

    draw: Draw
    facts: dict[str, Any]
    shape: tuple[int, ...]
    slot: int
    fresh: bool
    ahead: bool
    seconds: float


@dataclass(frozen=True)
class Failed:
    """Why a clip could not be drawn; `refused`: by a ValueError."""

    why: str
    refused: bool


class Drawer:
    """A process that draws clips, seen from the one that asks for them."""

    def __init__(self, process: BaseProcess, link: Connection):
        self.process, self.link = process, link
        self.slots: list[mmap.mmap | None] = [None] * SLOTS

    def take(self, index: int, until: float | None) -> Drawn | None:
        """Return its next clip, which is `index`; None: not before `until` of time.monotonic.

        Raises ValueError for a clip that is refused, RuntimeError for one that fails or whose
        process died; both name the clip.
        """
        try:
            while True:
                left = PATIENCE if until is None else until - time.monotonic()
                if left <= 0:
                    return None
                if self.link.poll(min(left, PATIENCE)):
                    break
            drawn = pickle.loads(self.link.recv_bytes())
            if isinstance(drawn, Drawn) and drawn.fresh:
                handle = recv_handle(self.link)
                self.slots[drawn.slot] = mmap.mmap(handle, os.fstat(handle).st_size)
                os.close(handle)
        except (EOFError, OSError) as error:
            self.process.join(PATIENCE)
            died = f"the process that draws it died (exit code {self.process.exitcode})"
            raise RuntimeError(f"clip {index}: {died}") from error
        if isinstance(drawn, Failed):
            raise (ValueError if drawn.refused else RuntimeError)(f"clip {index}: {drawn.why}")
        return drawn

    def frames(self, drawn: Drawn, device: torch.device, more: bool) -> Tensor:
        """Return a clip's frames on the device; their slot is free again, if `more` are to come."""
        shared = np.frombuffer(self.slots[drawn.slot], np.float32, int(np.prod(drawn.shape)))
        here = torch.from_numpy(shared.reshape(drawn.shape))
        frames = here.clone() if device.type == "cpu" else moved(here, device)
        if more:
            with suppress(OSError):  # that it died is told when its next clip is asked for
                self.link.send_bytes(b"free")
        return frames


@contextmanager
def drawers(
    source: Pipeline, shares: Sequence[Sequence[int]], *, ahead: bool
) -> Iterator[list[Drawer]]:
    """Start a process for each of `shares`, the numbers of its clips; `ahead`: they prepare air.

    All have ended afterwards, whatever happened, and do so if this process is killed.
    """
    spawn, started = multiprocessing.get_context("spawn"), []  # a fork would take CUDA along
    try:
        for share in shares:
            ours, theirs = spawn.Pipe()
            arguments = (source, share, ahead, theirs)
            process = spawn.Process(target=_draw, args=arguments, daemon=True)
            process.start()
            theirs.close()  # or its end would not be noticed
            started.append(Drawer(process, ours))
        yield started
    finally:
        for drawer in started:
            drawer.process.kill()
        for drawer in started:
            drawer.process.join()
            drawer.link.close()


def _draw(source: Pipeline, indices: Sequence[int], ahead: bool, link: Connection) -> None:
    """Draw clips into slots as they are free; ends with who asked, whatever became of that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one that asks
    os.environ["CUDA_VISIBLE_DEVICES"] = ""  # and so is its device
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    slots: list[mmap.mmap | None] = [None] * SLOTS
    try:
        for number, index in enumerate(indices):
            if number >= SLOTS:
                link.recv_bytes()
            try:
                drawn, frames = _drawn(source, index, ahead)
            except Exception as error:  # told by the one that asks, in its words
                link.send_bytes(pickle.dumps(_failed(error)))
                return
            _send(link, slots, number % SLOTS, drawn, frames)
    except (EOFError, OSError):  # nobody asks any more
        return


def _drawn(source: Pipeline, index: int, ahead: bool) -> tuple[Drawn, np.ndarray]:
    begin = time.monotonic()
    draw = source.draw(index)
    facts = facts_of(source, draw)
    air = source.operator(draw) if ahead else None
    ahead = isinstance(air, PreparedAir)
    frames = draw.clip.frames.float().numpy()
    if ahead:
        draw = replace(draw, air=air.ahead(len(frames), source.drawer(draw), draw.crop))
    bare = replace(draw.clip, frames=torch.empty(0, 0, 0), truth=None)
    draw = replace(draw, clip=bare)
    return Drawn(draw, facts, frames.shape, 0, False, ahead, time.monotonic() - begin), frames


def facts_of(source: Pipeline, draw: Draw) -> dict[str, Any]:
    """Return what is kept of a clip beside its pictures: plain data."""
    air = {"record": source.record(draw), "air": repr(draw.air)}
    return {"name": draw.clip.name, "fps": draw.clip.fps} | air


def _failed(error: Exception) -> Failed:
    refused = isinstance(error, ValueError)
    return Failed(str(error) if refused else f"{type(error).__name__}: {error}", refused)


def _send(
    link: Connection,
    slots: list[mmap.mmap | None],
    slot: int,
    drawn: Drawn,
    frames: np.ndarray,
) -> None:
    """Put a clip's frames in a slot and send the rest; OSError where nobody listens."""
    fresh, handle = slots[slot] is None or len(slots[slot]) < frames.nbytes, -1
    if fresh:
        handle = os.memfd_create("clip")
        os.truncate(handle, frames.nbytes)
        slots[slot] = mmap.mmap(handle, frames.nbytes)
    np.frombuffer(slots[slot], np.float32, frames.size)[:] = frames.ravel()
    link.send_bytes(pickle.dumps(replace(drawn, slot=slot, fresh=fresh), pickle.HIGHEST_PROTOCOL))
    if fresh:
        send_handle(link, handle, None)
        os.close(handle)
