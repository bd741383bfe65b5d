"""Where live events come from: a file, played; packets over UDP; a camera."""

import errno
import select
import socket
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from urllib.parse import urlsplit

import numpy as np

from src.live_view.status import FaultLog
from src.recordings.files import recording_inputs
from src.recordings.files.clocks import TimestampUnwrapper
from src.recordings.files.event_file import EVENT, ReadOptions
from src.recordings.files.recording import EventRecording, cut_chunks, open_recording
from src.recordings.sensor_limits import are_sensor_sides
from src.recordings.views import HeightWidth

Chunks = Iterator[tuple[np.ndarray, float]]  # events (t x y p), wall time of their arrival in s
FILE_CHUNK_S = 0.005  # of a file, read at a time: a long one would hold the other threads up
GATHER_S = 0.002  # for which packets are gathered into one chunk
GATHER_BYTES = 1 << 20
MAX_PACKET_BYTES = 65536
KERNEL_BUFFER_BYTES = 1 << 23  # asked of the kernel for packets that wait
SO_MEMINFO, MEMINFO_WORDS, DROPS = 55, 9, 8  # of a Linux socket: uint32, the last its lost packets
MAX_TIME_US = 2**53  # a time beyond is a broken packet
RETRY_S = 1.0  # after which a lost camera is looked for again
PACKETS = {  # of faery
    "t64_x16_y16_on8": np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")]),
    "t32_x16_y15_on1": np.dtype([("t", "<u4"), ("x", "<u2"), ("y", "<u2")]),
}


class Feed(ABC):
    """`is_live`: whether events come while they happen.  `sensor`: (height, width) in pixels.
    `messages`: what is said at the start."""

    is_live = True
    sensor: HeightWidth
    messages: tuple[str, ...] = ()

    @abstractmethod
    def iter_event_chunks(self, stopped: threading.Event) -> Chunks:
        """Yield chunks of events until `stopped`; an empty one: a recording starts again."""

    def close(self) -> None:  # noqa: B027 - most have nothing open
        """Release what is open."""


def open_feed(
    recording: str,
    sensor: Sequence[int] | None,
    faults: FaultLog,
    *,
    loop: bool = False,
    udp_format: str = "t64_x16_y16_on8",
    options: ReadOptions = ReadOptions(),
    in_views: HeightWidth | None = None,
) -> Feed:
    """Return the feed of `recording`: a path, `udp://address:port` or `camera://`; `sensor`:
    (height, width), before what a file states; `in_views`: that of the views, where neither says.
    Raises ValueError for what cannot be read or holds no event, and for a `udp_format` that is none
    of PACKETS."""
    if udp_format not in PACKETS:
        raise ValueError(f"udp_format must be one of {', '.join(PACKETS)}, got {udp_format}")
    if recording.startswith("camera://"):
        return CameraFeed(faults)
    if not recording.startswith("udp://"):
        size = recording_inputs.find_sensor_size(recording, sensor, options, in_views)
        opened = open_recording(recording, size, options)
        opened.check_sensor_size()
        if next(iter(opened), None) is None:
            raise ValueError(f"{recording}: holds no events")
        if lines := opened.messages:
            faults.report("reading", "; ".join(lines), until_cleared=True)
        return FileFeed(opened, size, loop)
    sensor = sensor or in_views
    if sensor is None or not are_sensor_sides(sensor):
        raise ValueError(
            f"sensor_size must be [height,width] for recording=udp://, got {sensor}; "
            "or give views=, which says it"
        )
    return UdpFeed(recording, (sensor[0], sensor[1]), udp_format, faults)


class FileFeed(Feed):
    """Events of a file; `loop`: again and again, each time from its first time stamp."""

    is_live = False

    def __init__(self, opened: EventRecording, sensor: HeightWidth, loop: bool):
        self.opened, self.sensor, self.loop = opened, sensor, loop

    def iter_event_chunks(self, stopped: threading.Event) -> Chunks:
        """Yield the file's events; raises ValueError where it cannot be decoded."""
        while not stopped.is_set():
            for events in cut_chunks(self.opened, FILE_CHUNK_S):
                yield events, time.perf_counter()
            if not self.loop:
                return
            yield np.empty(0, EVENT), time.perf_counter()


class UdpFeed(Feed):
    """Events in packets of one of PACKETS that arrive at `udp://address:port`.

    Raises ValueError for an address that cannot be listened at.
    """

    def __init__(self, url: str, sensor: HeightWidth, packet_format: str, faults: FaultLog):
        self.sensor, self.packet_format, self.faults = sensor, packet_format, faults
        self.dtype = PACKETS[packet_format]
        self.buffer = memoryview(bytearray(GATHER_BYTES + MAX_PACKET_BYTES))
        self.clock = TimestampUnwrapper(is_live=True)
        self.lost_packets = 0
        self.socket = _bind_udp_socket(url)
        granted = _granted_buffer_bytes(self.socket)
        if granted < KERNEL_BUFFER_BYTES:
            self.messages = (
                f"the kernel's buffer for packets is {granted} bytes of {KERNEL_BUFFER_BYTES}: "
                f"raise it with sysctl -w net.core.rmem_max={KERNEL_BUFFER_BYTES}",
            )

    def iter_event_chunks(self, stopped: threading.Event) -> Chunks:
        """Yield what came, as soon as it came."""
        while not stopped.is_set():
            if select.select([self.socket], [], [], 0.1)[0]:
                size = self._gather_packets()
                self._report_lost_packets()
                events = self.unpack(np.frombuffer(self.buffer[:size], self.dtype))
                if events.size:
                    yield events, time.perf_counter()

    def _gather_packets(self) -> int:
        """Put the packets that wait one behind the other; return their bytes."""
        size, end = 0, time.perf_counter() + GATHER_S
        while size < GATHER_BYTES and time.perf_counter() < end:
            try:
                received = self.socket.recv_into(self.buffer[size:], MAX_PACKET_BYTES)
            except BlockingIOError:
                break
            if received % self.dtype.itemsize:
                text = f"packets that are not {self.packet_format}: left out"
                self.faults.report("packet", text, 1)
            else:
                size += received
        return size

    def unpack(self, packed: np.ndarray) -> np.ndarray:
        """Return packed events as (t x y p); those with impossible times are left out.

        32 bits of microseconds turn every 71.6 minutes: the turns are added.
        """
        if self.packet_format == "t64_x16_y16_on8":
            t, on, y = packed["t"].astype(np.int64), packed["p"] != 0, packed["y"]
        else:
            t, on, y = self.clock.unwrap(packed["t"]), packed["y"] & 1, packed["y"] >> 1
        is_valid = (t >= 0) & (t < MAX_TIME_US)
        if not is_valid.all():
            text = f"events with times that are not of {self.packet_format}: left out"
            self.faults.report("invalid", text, int((~is_valid).sum()))
        return _as_events(t, packed["x"], y, on)[is_valid]

    def _report_lost_packets(self) -> None:
        """Say how many packets found no room in the kernel's buffer."""
        lost = count_lost_packets(self.socket)
        if new := (lost - self.lost_packets) % 2**32:  # the kernel counts in 32 bits
            text = "packets came faster than they are read, or net.core.rmem_max is too small"
            self.faults.report("kernel", text, new)
        self.lost_packets = lost

    def close(self) -> None:
        self.socket.close()


def count_lost_packets(udp: socket.socket) -> int:
    """Return how many packets found no room in the buffer of `udp`, modulo 2^32; 0 where the system
    does not say (all but Linux)."""
    if sys.platform != "linux":
        return 0
    try:
        packed = udp.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * MEMINFO_WORDS)
    except OSError:  # a kernel before 4.12
        return 0
    words = np.frombuffer(packed, np.uint32)
    return int(words[DROPS]) if len(words) > DROPS else 0


def _granted_buffer_bytes(udp: socket.socket) -> int:
    """Return the bytes the kernel holds for packets that wait: Linux says twice as many."""
    said = udp.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    return said // 2 if sys.platform == "linux" else said


def _bind_udp_socket(url: str) -> socket.socket:
    """Return a socket that packets to `url` arrive at; raises ValueError where there is none."""
    try:
        parts = urlsplit(url)
        if parts.port is None:
            raise ValueError("no port")
        return _bind(parts.hostname or "", parts.port)
    except (OSError, ValueError) as error:
        is_taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        reason = "another program listens there: end it or choose another port"
        line = f"recording must be udp://address:port, got {url}: {reason if is_taken else error}"
        raise ValueError(line) from None


def _bind(host: str, port: int) -> socket.socket:
    """Return a socket that packets to a port arrive at; raises OSError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_DGRAM)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, KERNEL_BUFFER_BYTES)
        bound.setblocking(False)
        bound.bind((host, port))
    except OSError:
        bound.close()
        raise
    return bound


class CameraFeed(Feed):
    """A camera that faery's drivers read; lost, it is looked for again: one of another sensor size
    is not taken.

    Raises ValueError where there is none, or no driver.
    """

    def __init__(self, faults: FaultLog):
        self.faults = faults
        self.stream = _open_camera()
        self.sensor = _sensor_of_camera(self.stream)

    def iter_event_chunks(self, stopped: threading.Event) -> Chunks:
        """Yield what the camera sends."""
        while not stopped.is_set():
            try:
                stream = self._open_same_camera() if self.stream is None else self.stream
                self.faults.clear("camera")
                for packet in stream:
                    events = _as_events(packet["t"], packet["x"], packet["y"], packet["on"])
                    if events.size:
                        yield events, time.perf_counter()
                    if stopped.is_set():
                        return
                reason = "it sends no more"
            except Exception as error:  # drivers raise all kinds
                reason = str(error)
            self.stream = None
            text = f"the camera is lost, looking for it: {reason}"
            self.faults.report("camera", text, until_cleared=True)
            stopped.wait(RETRY_S)

    def _open_same_camera(self):
        """Return the stream of a camera; raises ValueError for one of another sensor size."""
        stream = _open_camera()
        if (found := _sensor_of_camera(stream)) != self.sensor:
            sizes = [f"{width}x{height}" for height, width in (self.sensor, found)]
            raise ValueError("the sensor must be {} as before, got a camera of {}".format(*sizes))
        return stream

    def close(self) -> None:
        self.stream = None


def _sensor_of_camera(stream) -> HeightWidth:
    width, height = stream.dimensions()
    return int(height), int(width)


def _open_camera():
    import faery  # here, as tests put another in its place

    try:
        return faery.events_stream_from_camera()
    except Exception as error:  # drivers raise all kinds
        reasons = " ".join(str(part) for part in error.args)
        raise ValueError(
            "recording=camera:// found no camera, or no driver for it; drivers come with "
            f"pip install event-camera-drivers neuromorphic-drivers: {reasons}"
        ) from None


def _as_events(t: np.ndarray, x: np.ndarray, y: np.ndarray, on: np.ndarray) -> np.ndarray:
    events = np.empty(len(t), EVENT)
    events["t"], events["x"], events["y"] = t, x, y
    events["p"] = 2 * on.astype(np.int8) - 1
    return events
