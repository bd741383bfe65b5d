"""What the page's status shows: faults of the stream, rates, latency and load of each stage."""

import threading
import time
from collections import deque

import numpy as np

SHOWN_S = 3.0  # after it was last reported, a fault is taken for over
COUNTS = {  # in the status, of the kinds of faults that concern some events or packets
    "late": "events_dropped",
    "order": "events_sorted",
    "size": "events_off_sensor",
    "lost": "events_not_cut",
    "invalid": "events_invalid",
    "packet": "packets_invalid",
    "kernel": "packets_lost",
}
STAGES = ("decode", "cut", "events", "network", "page")


class FaultLog:
    """One line for each kind of fault, with how many events or packets it concerned so far."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.lines: dict[str, tuple[float, str]] = {}
        self.totals = dict.fromkeys(COUNTS, 0)

    def report(self, kind: str, text: str, count: int = 0, *, until_cleared: bool = False) -> None:
        """Show `text` for SHOWN_S or until `clear`; `count` adds to the total of its kind, which is
        one of COUNTS."""
        end = float("inf") if until_cleared else time.perf_counter() + SHOWN_S
        with self.lock:
            self.lines[kind] = (end, text)
            if count:
                self.totals[kind] += count

    def clear(self, kind: str) -> None:
        """Remove the line of a kind."""
        with self.lock:
            self.lines.pop(kind, None)

    def current(self) -> list[str]:
        """Return the lines of the faults that are not over."""
        with self.lock:
            now = time.perf_counter()
            self.lines = {kind: line for kind, line in self.lines.items() if line[0] > now}
            return [text + self._describe_total(kind) for kind, (_, text) in self.lines.items()]

    def _describe_total(self, kind: str) -> str:
        total = self.totals.get(kind)
        return f" ({total:,} {COUNTS[kind].partition('_')[0]})" if total else ""

    def counts(self) -> dict[str, int]:
        """Return what was concerned since the start, by the names of COUNTS."""
        with self.lock:
            return {name: self.totals[kind] for kind, name in COUNTS.items()}


class PipelineCounters:
    """Counts of a running chain; `span_s`: the seconds that rates and latency are taken over."""

    def __init__(self, span_s: float = 2.0):
        self.span_s = span_s
        self.lock = threading.Lock()
        self.frames: deque[tuple[float, float, int]] = deque()  # wall s, latency s, events
        self.busy_s = dict.fromkeys(STAGES, 0.0)  # since the start
        self.before = (time.perf_counter(), dict(self.busy_s))
        self.loads = dict.fromkeys(STAGES, 0.0)

    def add_frame(self, latency_s: float, events: int) -> None:
        """Count a frame that is shown `latency_s` after its window was over."""
        now = time.perf_counter()
        with self.lock:
            self.frames.append((now, latency_s, events))
            self._forget(now)

    def add_busy_time(self, stage: str, seconds: float) -> None:
        """Count `seconds` of CPU time of a stage's thread."""
        self.busy_s[stage] += seconds

    def _forget(self, now: float) -> None:
        while self.frames and self.frames[0][0] < now - self.span_s:
            self.frames.popleft()

    def measure_rates_and_latency(self) -> dict:
        """Return `fps`, `events_per_s` and `latency_ms` (median, p99; None without frames)."""
        now = time.perf_counter()
        with self.lock:
            self._forget(now)
            frames = np.array(self.frames).reshape(-1, 3)
        if not len(frames):
            return {"fps": 0.0, "events_per_s": 0, "latency_ms": {"median": None, "p99": None}}
        span = min(self.span_s, max(now - frames[0, 0], 0.1))
        median, high = np.percentile(frames[:, 1] * 1e3, [50, 99])
        return {
            "fps": round(len(frames) / span, 1),
            "events_per_s": round(frames[:, 2].sum() / span),
            "latency_ms": {"median": round(median, 2), "p99": round(high, 2)},
        }

    def stage_cpu_shares(self) -> dict[str, float]:
        """Return the share of a core, CPU time of its thread, that each stage took since about a
        second before."""
        now, busy = time.perf_counter(), dict(self.busy_s)
        at, before = self.before
        if now - at >= 1.0:
            self.loads = {name: round((busy[name] - before[name]) / (now - at), 3) for name in busy}
            self.before = now, busy
        return self.loads
