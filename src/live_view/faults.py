"""What is wrong with the stream just now, in words, for the page."""

import threading
import time

SHOWN_S = 3.0  # after it was last seen, a fault is taken for over


class Faults:
    """One line for each kind of fault, with how often it came; a line goes when it is over."""

    def __init__(self):
        self.lock = threading.Lock()
        self.lines: dict[str, tuple[float, str, int]] = {}

    def tell(self, kind: str, text: str, count: int = 0, *, stays: bool = False) -> None:
        """Show `text`; `count` adds to the earlier ones of its kind.  `stays`: until cleared."""
        until = float("inf") if stays else time.perf_counter() + SHOWN_S
        with self.lock:
            _, _, before = self.lines.get(kind, (0.0, "", 0))
            self.lines[kind] = (until, text, before + count)

    def clear(self, kind: str) -> None:
        """Take the line of a kind away."""
        with self.lock:
            self.lines.pop(kind, None)

    def has(self, kind: str) -> bool:
        """Return whether there is a line of a kind."""
        return kind in self.lines

    def now(self) -> list[str]:
        """Return the lines that are shown now."""
        with self.lock:
            now = time.perf_counter()
            self.lines = {kind: line for kind, line in self.lines.items() if line[0] > now}
            lines = list(self.lines.values())
        return [f"{text} ({count:,} events)" if count else text for _, text, count in lines]
