"""Where live events come from: a file, played; packets over UDP; a camera."""

import select
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Protocol, runtime_checkable
from urllib.parse import urlsplit

import numpy as np

from src.live_view.faults import Faults
from src.recordings.files import sources
from src.recordings.files.formats import EVENT
from src.recordings.noise_filter import NoiseFilter
from src.recordings.views import LARGEST_SIDE, Size

Chunks = Iterator[tuple[np.ndarray, float]]
CHUNK_S = 0.005  # of a file, read at a time: a long one would hold the other threads up
GATHER_S = 0.002  # for which packets are gathered into one chunk
BUFFER = 1 << 20  # bytes of packets gathered
KERNEL_BUFFER = 1 << 23  # bytes asked of the kernel for packets that wait
LATEST = 2**53  # us; a time beyond is a broken packet
RETRY_S = 1.0  # after which a lost camera is looked for again
PACKETS = {
    "t64_x16_y16_on8": np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")]),
    "t32_x16_y15_on1": np.dtype([("t", "<u4"), ("x", "<u2"), ("y", "<u2")]),
}


@runtime_checkable
class Feed(Protocol):
    """`live`: whether events come while they happen.  `sensor`: (height, width) in pixels."""

    live: bool
    sensor: Size

    def chunks(self, stopped: threading.Event) -> Chunks:
        """Yield events (t x y p) and the wall time of their arrival until `stopped`."""
        ...

    def close(self) -> None:
        """Let go of what is open."""
        ...


def open_feed(
    recording: str,
    sensor: Sequence[int] | None,
    faults: Faults,
    *,
    loop: bool = False,
    udp_format: str = "t64_x16_y16_on8",
) -> Feed:
    """Return the feed of `recording`: a path, `udp://address:port` or `camera://`.

    `sensor` (height, width) where the recording does not say.  Raises ValueError for a file, an
    address or a format that cannot be read.
    """
    if recording.startswith("udp://"):
        return Udp(recording, _stated(sensor), udp_format, faults)
    if recording.startswith("camera://"):
        return Camera(faults)
    return File(recording, sources.sensor_size(recording, sensor), loop)


def _stated(sensor: Sequence[int] | None) -> Size:
    if sensor is None or not all(1 <= side <= LARGEST_SIDE for side in sensor):
        raise ValueError(
            f"sensor_size must be [height,width] for recording=udp://, got {sensor}; "
            "or give views=, which says it"
        )
    return tuple(sensor)


class Filtered:
    """Another feed's events without those that `NoiseFilter` takes away."""

    def __init__(self, feed: Feed, seconds: float):
        self.feed, self.live, self.sensor = feed, feed.live, feed.sensor
        self.filter = NoiseFilter(feed.sensor, seconds)

    def chunks(self, stopped: threading.Event) -> Chunks:
        """Yield what is left of each chunk, if anything is."""
        for events, arrived in self.feed.chunks(stopped):
            kept = self.filter(events)
            if kept.size:
                yield kept, arrived

    def close(self) -> None:
        """Close the other feed."""
        self.feed.close()


class File:
    """Events of a file, read ahead; `loop`: from the start again, the clock going on."""

    live = False

    def __init__(self, path: str, sensor: Size, loop: bool):
        self.path, self.sensor, self.loop = path, sensor, loop

    def chunks(self, stopped: threading.Event) -> Chunks:
        """Yield the file's events; raises ValueError where it cannot be decoded."""
        shift, last = 0, None
        while not stopped.is_set():
            first = None
            for events in sources.events(self.path, self.sensor, CHUNK_S):
                first = int(events["t"][0]) if first is None else first
                last = int(events["t"][-1])
                if shift:
                    events["t"] += shift
                yield events, time.perf_counter()
            if not self.loop or first is None:
                return
            shift += last + 1 - first

    def close(self) -> None:
        """Nothing stays open."""


class Udp:
    """Events in packets of one of faery's formats (PACKETS), `udp://address:port`.

    Raises ValueError for an address that cannot be listened at.
    """

    live = True

    def __init__(self, url: str, sensor: Size, kind: str, faults: Faults):
        if kind not in PACKETS:
            raise ValueError(f"udp_format must be one of {', '.join(PACKETS)}, got {kind}")
        self.sensor, self.kind, self.faults = sensor, kind, faults
        self.buffer = memoryview(bytearray(BUFFER + 65536))
        self.wraps, self.before = 0, 0
        try:
            self.socket = _listening(url)
        except (OSError, ValueError) as error:
            raise ValueError(f"recording must be udp://address:port, got {url}: {error}") from None

    def chunks(self, stopped: threading.Event) -> Chunks:
        """Yield what came, as soon as it came."""
        while not stopped.is_set():
            if select.select([self.socket], [], [], 0.1)[0]:
                size = self._gathered()
                events = self._events(np.frombuffer(self.buffer[:size], PACKETS[self.kind]))
                if events.size:
                    yield events, time.perf_counter()

    def _gathered(self) -> int:
        """Put the packets that wait one behind the other; return their bytes."""
        size, item, end = 0, PACKETS[self.kind].itemsize, time.perf_counter() + GATHER_S
        while size < BUFFER and time.perf_counter() < end:
            try:
                got = self.socket.recv_into(self.buffer[size:], 65536)
            except BlockingIOError:
                break
            if got % item:
                self.faults.tell("packet", f"packets that are not {self.kind}: left out")
            else:
                size += got
        return size

    def _events(self, packed: np.ndarray) -> np.ndarray:
        events = np.empty(len(packed), EVENT)
        t = packed["t"].astype(np.int64)
        if self.kind == "t32_x16_y15_on1":
            t = self._unwrapped(t)
            events["y"], on = packed["y"] >> 1, packed["y"] & 1
        else:
            events["y"], on = packed["y"], packed["p"] != 0
        events["t"], events["x"], events["p"] = t, packed["x"], 2 * on.astype(np.int8) - 1
        sound = (t >= 0) & (t < LATEST)
        if sound.all():
            return events
        self.faults.tell("packet", f"packets that are not {self.kind}: left out")
        return events[sound]

    def _unwrapped(self, t: np.ndarray) -> np.ndarray:
        """Return times without the turn that 32 bits of microseconds make every 71.6 minutes."""
        if t.size:
            turns = self.wraps + np.cumsum(np.diff(t, prepend=self.before) < -(2**31))
            self.wraps, self.before = int(turns[-1]), int(t[-1])
            t = t + (turns << 32)
        return t

    def close(self) -> None:
        """Stop listening."""
        self.socket.close()


def _listening(url: str) -> socket.socket:
    """Return a socket that packets to `url` arrive at; OSError or ValueError where there is none"""
    parts = urlsplit(url)
    if parts.port is None:
        raise ValueError("no port")
    family = socket.AF_INET6 if ":" in (parts.hostname or "") else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_DGRAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, KERNEL_BUFFER)
        listening.setblocking(False)
        listening.bind((parts.hostname or "", parts.port))
    except OSError:
        listening.close()
        raise
    return listening


class Camera:
    """A camera that faery's drivers read; lost, it is looked for again.

    Raises ValueError where there is none, or no driver.
    """

    live = True

    def __init__(self, faults: Faults):
        self.faults = faults
        self.stream = _camera()
        width, height = self.stream.dimensions()
        self.sensor = (int(height), int(width))

    def chunks(self, stopped: threading.Event) -> Chunks:
        """Yield what the camera sends."""
        while not stopped.is_set():
            try:
                stream = _camera() if self.stream is None else self.stream
                self.faults.clear("camera")
                for packet in stream:
                    yield _from_faery(packet), time.perf_counter()
                    if stopped.is_set():
                        return
                lost = "it sends no more"
            except Exception as error:  # drivers raise all kinds
                lost = str(error)
            self.stream = None
            self.faults.tell("camera", f"the camera is lost, looking for it: {lost}", stays=True)
            stopped.wait(RETRY_S)

    def close(self) -> None:
        """Let go of the camera."""
        self.stream = None


def _camera():
    import faery  # here, as tests put another in its place

    try:
        return faery.events_stream_from_camera()
    except Exception as error:  # drivers raise all kinds
        reasons = " ".join(str(part) for part in error.args)
        raise ValueError(
            "recording=camera:// found no camera, or no driver for it; drivers come with "
            f"pip install event-camera-drivers neuromorphic-drivers: {reasons}"
        ) from None


def _from_faery(packet: np.ndarray) -> np.ndarray:
    events = np.empty(len(packet), EVENT)
    events["t"], events["x"], events["y"] = packet["t"], packet["x"], packet["y"]
    events["p"] = 2 * packet["on"].astype(np.int8) - 1
    return events
