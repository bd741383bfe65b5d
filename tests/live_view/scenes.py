"""A small recording with nine views, and a sender that plays it over UDP."""

import socket
import threading
import time

import faery
import numpy as np
import torch

from src.recordings import simulated_recording
from src.recordings.views import Views
from src.sim.optics import layout
from src.sim.sensor.sensor import EventSensor
from tests.recordings import pictures

SENSOR, SIDE = (360, 640), 88
FPS = 300.0


def views() -> Views:
    """Return nine views on one sensor."""
    return simulated_recording.kaleidoscope_views(
        list(layout(9)), model=(SIDE, SIDE), sensor=SENSOR, tile_px=116.0, homography_error_px=1.0
    )


def events(seconds: float = 0.5) -> np.ndarray:
    """Return the events of a dot that circles in all views."""
    angle = np.linspace(0, 2 * np.pi, round(seconds * FPS) + 1)
    path = SIDE / 2 + 22 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    size, light = np.full((len(path), 1), 5.0), np.full((len(path), 1), 0.9)
    film = pictures.dot_grid(path[:, None], size, light, SIDE) - 0.7
    frames = torch.from_numpy(film).float().clamp(0, 1)[None].expand(9, -1, -1, -1)
    return simulated_recording.record_events(
        frames, FPS, views(), EventSensor(0.4, refractory_s=1e-3, dark_noise_hz=0.5)
    )


class Sender:
    """Sends `events`, round and round at their pace, as faery packs them, until closed."""

    def __init__(self, events: np.ndarray, port: int, first_us: int = 0, side: int = 0):
        self.address = ("127.0.0.1", port)
        self.packed = np.empty(len(events), faery.EVENTS_DTYPE)
        self.packed["t"], self.packed["on"] = events["t"] - events["t"][0], events["p"] > 0
        self.packed["x"], self.packed["y"] = events["x"] + side, events["y"]
        self.first_us, self.stopped = first_us, threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Sender":
        self.thread.start()
        return self

    def __exit__(self, *error) -> None:
        self.stopped.set()
        self.thread.join()

    def _run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            self._send(sender)

    def _send(self, sender: socket.socket) -> None:
        length, began, sent = int(self.packed["t"][-1]) + 1, time.perf_counter(), 0
        while not self.stopped.wait(0.01):
            now = int((time.perf_counter() - began) * 1e6)
            while sent < now:
                turn, start = divmod(sent, length)
                stop = min(length, start + now - sent)
                first, last = np.searchsorted(self.packed["t"], [start, stop])
                part = self.packed[first:last].copy()
                part["t"] += self.first_us + turn * length
                for k in range(0, len(part), 100):
                    sender.sendto(part[k : k + 100].tobytes(), self.address)
                sent += stop - start
