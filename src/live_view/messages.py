"""What goes to the page and what comes from it, over one WebSocket.

A message is the length of a JSON header (uint32, little endian), the header, and the JPEGs it
lists.  The browser sends JSON: pause, line, network and views, all_views.
"""

import json
import math
import time

from src.live_view import paint
from src.live_view.controls import Controls
from src.live_view.player import Player
from src.live_view.screen import EventPicture, Slice

STATUS_S = 0.25  # between two readings of the meters on the page


class Page:
    """Draws what all visitors see, RATE times a second, while there is one."""

    def __init__(self, player: Player, controls: Controls, marks: EventPicture, positions: list):
        self.player, self.controls, self.marks = player, controls, marks
        self.positions = positions
        self.screen = player.reconstruction.screen
        self.slice = Slice(self.screen)
        self.all_views = False
        self.shown = -1  # count of frames at the last picture
        self.sent = 0.0  # when the meters were last sent

    def message(self, *, whole: bool = False) -> bytes | None:
        """Return what is new since the last call, or everything; None where nothing is."""
        pictures = self._pictures(whole)
        header: dict = {"pictures": [[name, len(data)] for name, data in pictures]}
        now = time.perf_counter()
        if whole or now - self.sent >= STATUS_S:
            self.sent, header["status"] = now, self.status()
        elif not pictures:
            return None
        text = json.dumps(header).encode()
        return len(text).to_bytes(4, "little") + text + b"".join(data for _, data in pictures)

    def status(self) -> dict:
        """Return the meters, and what is chosen and offered."""
        status = self.player.status()
        asked = status["asked_fps"]
        return status | {
            "line": self.slice.line,
            "slice_s": round(len(self.screen.ring) / asked, 2) if asked else None,
            "all_views": self.all_views,
            "offered": self.controls.offered(),
            "chosen": self.controls.chosen,
        }

    def _pictures(self, whole: bool) -> list[tuple[str, bytes]]:
        if not self.screen.count:
            return []
        pictures, count = [], self.screen.count
        if whole or count != self.shown:
            self.shown = count
            pictures.append(("frame", paint.jpeg(self.screen.newest())))
        if whole or self.marks.windows:
            counts = self.marks.take()
            centre = self.positions.index((0, 0)) if (0, 0) in self.positions else 0
            pictures.append(("events", paint.jpeg(paint.events(counts[centre]))))
            if self.all_views:
                pictures.append(("views", paint.jpeg(paint.side_by_side(counts, self.positions))))
        drawn = self.slice.draw(anew=whole)
        return pictures if drawn is None else [*pictures, ("slice", paint.jpeg(drawn))]

    def obey(self, asked: dict) -> None:
        """Do what a visitor asks; raises ValueError for what makes no sense."""
        if "pause" in asked:
            self.player.pause(bool(asked["pause"]))
        if "all_views" in asked:
            self.all_views = bool(asked["all_views"])
        if "line" in asked:
            self.slice.line = _line(asked["line"])
        if "network" in asked:
            views = asked.get("views")
            if type(views) not in (int, str):
                raise ValueError(f"views_used must be a number or adaptive, got {views}")
            self.controls.choose(str(asked["network"]), views)


def _line(numbers: object) -> tuple[float, float, float, float]:
    right = isinstance(numbers, list) and len(numbers) == 4
    if not right or not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers):
        raise ValueError(f"line must be x0, y0, x1, y1 in pixels, got {numbers}")
    return tuple(min(max(float(n), -1e4), 1e4) for n in numbers)
