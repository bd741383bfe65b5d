"""The threads from events to the page's buffer, and their state."""

import math
import queue
import threading
import time
import traceback

import numpy as np

from src.live_view.feed_reader import FeedReader
from src.live_view.frame_buffer import FrameRing
from src.live_view.live_windows import EventWindow
from src.live_view.network_runner import Controls, Finish, NetworkRunner
from src.recordings.tone import ToneCurve

SPARED = 0.95  # of the frames a second that were reached, to have time to spare
JOIN_S = 2.0  # for which a thread is waited for at the end


class Player:
    """Four threads: decode, cut, events, network.  What waits between two is bounded.

    The last two run what `controls` have chosen and put the pictures into `frames`.
    """

    def __init__(self, reader: FeedReader, controls: Controls, frames: FrameRing):
        self.reader, self.controls, self.frames = reader, controls, frames
        self.meters, self.faults = reader.meters, reader.faults
        self.tone, self.one_view_tone = ToneCurve(), ToneCurve()
        self.running: NetworkRunner | None = None  # of the newest window
        self.running_one_view: NetworkRunner | None = None
        self.one_view: np.ndarray | None = None  # newest frame of the network on one view
        self.shown_us: float | None = None  # recorded time of the newest frame
        self.dropped = 0  # windows, when it was looked last
        self.dropped_s = -math.inf  # wall time of the last of them
        self.begun: queue.Queue[tuple[EventWindow, Finish, Finish | None]] = queue.Queue(1)
        self.stopped = threading.Event()
        self.threads = [
            threading.Thread(target=self._guard, args=(work,), name=work.__name__, daemon=True)
            for work in (reader.decode, reader.cut, self.run_first_layer, self.run_network)
        ]

    def start(self) -> None:
        """Start playing."""
        for thread in self.threads:
            thread.start()

    def stop(self) -> None:
        """End the threads and close the feed."""
        self.stopped.set()
        for thread in self.threads:
            if thread.ident is not None:
                thread.join(JOIN_S)
        self.reader.feed.close()

    def _guard(self, work) -> None:
        try:
            work(self.stopped)
        except Exception as error:  # a thread that ends must not end unseen
            traceback.print_exc()
            self.faults.report("thread", f"{work.__name__} ended: {error}", until_cleared=True)
            self.reader.state = "broken"

    def run_first_layer(self, stopped: threading.Event) -> None:
        """Add the events to the first layer, a window ahead of `run_network`, until `stopped`."""
        while not stopped.is_set():
            window, runner = self.reader.waiting.get(0.1), self.controls.runner
            if window is None or runner is None:
                continue
            start = time.thread_time()
            is_new = window.starts_scene or runner is not self.running
            self.running = runner
            finish = runner.begin(window, restart=is_new)
            beside = self._begin_one_view(window)
            self.meters.add_busy_time("events", time.thread_time() - start)
            while not stopped.is_set():
                try:
                    self.begun.put((window, finish, beside), timeout=0.1)
                    break
                except queue.Full:
                    continue

    def _begin_one_view(self, window: EventWindow) -> Finish | None:
        runner = self.controls.one_view_runner
        is_new = window.starts_scene or runner is not self.running_one_view
        self.running_one_view = runner
        return runner.begin(window, restart=is_new) if runner else None

    def set_tone(self, tone: str, time_constant_s: float | None = None) -> None:
        """Show pictures with another tone; raises ValueError for one that there is not."""
        seconds = self.tone.time_constant_s if time_constant_s is None else time_constant_s
        self.tone, self.one_view_tone = ToneCurve(tone, seconds), ToneCurve(tone, seconds)

    def run_network(self, stopped: threading.Event) -> None:
        """Run the network on what was begun, and show the pictures, until `stopped`."""
        while not stopped.is_set():
            try:
                window, finish, beside = self.begun.get(timeout=0.1)
            except queue.Empty:
                continue
            start, end_s = time.thread_time(), window.end_us * 1e-6
            self.frames.push(self.tone.apply(finish(), end_s))
            self.one_view = None if beside is None else self.one_view_tone.apply(beside(), end_s)
            self.shown_us = window.end_us
            self.meters.add_busy_time("network", time.thread_time() - start)
            self.meters.add_frame(time.perf_counter() - window.due_s, len(window.events))
            self._note_dropped()

    def _note_dropped(self) -> None:
        if self.dropped != self.reader.waiting.dropped:
            self.dropped, self.dropped_s = self.reader.waiting.dropped, time.perf_counter()

    def set_paused(self, paused: bool) -> None:
        """Pause or play.  What a live stream sends during a pause is left out."""
        running = self.reader.clock.running
        (running.clear if paused else running.set)()

    def _suggest_fps(self, reached: float, asked: float) -> str | None:
        """Return what to set where windows were dropped in the seconds that rates are taken over,
        in frames per second of recorded time; None where none was.  `reached` and `asked` are per
        second of the clock on the wall.

        What a window costs is that of the present ones: of longer ones, with more events, more.
        """
        suggested = math.floor(SPARED * reached / self.reader.clock.speed)
        is_short = self.reader.state == "playing" and reached < SPARED * asked < math.inf
        is_dropping = time.perf_counter() - self.dropped_s < self.meters.span_s
        if not (is_short and is_dropping and suggested):
            return None
        return f"fps={suggested} or less (of recorded time) drops fewer; longer windows take longer"

    def status(self) -> dict:
        """Return what `GET /status` answers, all but the page's own."""
        reader, runner = self.reader, self.running
        asked_fps = reader.clock.speed * 1e6 / reader.cutter.period_us
        rates = self.meters.measure_rates_and_latency()
        paused = not reader.clock.running.is_set()
        return {
            "state": "paused" if paused and reader.state != "broken" else reader.state,
            "paused": paused,
            "faults": self.faults.current(),
            "counts": self.faults.counts(),
            "tone": self.tone.tone,
            "asked_fps": round(asked_fps, 1) if math.isfinite(asked_fps) else None,
            **rates,
            "dropped": reader.waiting.dropped,
            "hint": self._suggest_fps(rates["fps"], asked_fps),
            "waiting": len(reader.waiting),
            "network": runner.name if runner else None,
            "views": len(runner.views.views) if runner else None,
            "load": self.meters.stage_cpu_shares(),
            "time_s": None if self.shown_us is None else round(self.shown_us * 1e-6, 3),
        }
