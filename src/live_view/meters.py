"""What the page's meters show: rates and latency of the last seconds, loads, what was dropped."""

import threading
import time
from collections import deque

import numpy as np

STAGES = ("decode", "cut", "events", "network", "page")


class Meters:
    """Counts of a running chain; `span_s`: the seconds that rates and latency are taken over."""

    def __init__(self, span_s: float = 2.0):
        self.span_s = span_s
        self.lock = threading.Lock()
        self.frames: deque[tuple[float, float, int]] = deque()  # wall, latency, events
        self.busy = dict.fromkeys(STAGES, 0.0)  # seconds since the start
        self.before = (time.perf_counter(), dict(self.busy))
        self.loads = dict.fromkeys(STAGES, 0.0)

    def frame(self, latency_s: float, events: int) -> None:
        """A frame is in the page's buffer, `latency_s` after its window was over."""
        now = time.perf_counter()
        with self.lock:
            self.frames.append((now, latency_s, events))
            self._forget(now)

    def spent(self, stage: str, seconds: float) -> None:
        """A stage was at work for `seconds` more."""
        self.busy[stage] += seconds

    def _forget(self, now: float) -> None:
        while self.frames and self.frames[0][0] < now - self.span_s:
            self.frames.popleft()

    def rates(self) -> dict:
        """Return `fps`, `events_per_s` and `latency_ms` (median, p99; None without frames)."""
        now = time.perf_counter()
        with self.lock:
            self._forget(now)
            frames = np.array(self.frames).reshape(-1, 3)
        latency = {"median": None, "p99": None}
        if not len(frames):
            return {"fps": 0.0, "events_per_s": 0, "latency_ms": latency}
        span = min(self.span_s, max(now - frames[0, 0], 0.1))
        median, high = np.percentile(frames[:, 1] * 1e3, [50, 99])
        return {
            "fps": round(len(frames) / span, 1),
            "events_per_s": round(frames[:, 2].sum() / span),
            "latency_ms": {"median": round(median, 2), "p99": round(high, 2)},
        }

    def load(self) -> dict[str, float]:
        """Return the share of a core that each stage took since about a second before."""
        now, busy = time.perf_counter(), dict(self.busy)
        at, before = self.before
        if now - at >= 1.0:
            self.loads = {name: round((busy[name] - before[name]) / (now - at), 3) for name in busy}
            self.before = now, busy
        return self.loads
