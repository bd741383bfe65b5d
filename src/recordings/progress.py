"""A line that says how far a reconstruction is: frames, events per second, times real time."""

import time
from collections.abc import Iterable, Iterator

from rich.progress import Progress, SpinnerColumn, TextColumn

from src.recordings.stream import Frame


def tell(frames: Iterable[Frame], overlap: int = 1) -> Iterator[Frame]:
    """Pass `frames` on; the line ends as a summary.  An event comes in `overlap` of the windows."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"))
    began, first, events, outside = time.perf_counter(), None, 0, 0
    with Progress(*columns, refresh_per_second=4) as progress:
        task = progress.add_task("reading")
        for count, frame in enumerate(frames, start=1):
            first = frame.time_s if first is None else first
            events, outside = events + frame.events, outside + frame.outside
            wall, length = time.perf_counter() - began, frame.time_s - first
            rate = (events + outside) / overlap / wall / 1e6
            share = outside / max(events + outside, 1)
            text = (
                f"{count} frames, {length:.3f} s, {rate:.2f} Mev/s, {length / wall:.2f} x real time"
                f", {share:.0%} in no view"
            )
            progress.update(task, description=text)
            yield frame
