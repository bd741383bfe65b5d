"""Messages of ROS that hold events, from their bytes, as their definitions lay them out.

EventArray of dvs_msgs, dv_ros_msgs and prophesee_event_msgs: header, uint32 height, width, a list
of uint16 x, y, time ts, bool polarity.  event_camera_msgs/EventPacket (event_array_msgs/EventArray
was its name): header, uint32 height, width, uint64 seq, time_base, string encoding, bool
is_bigendian, uint8[] events.  Of its encodings evt3 (Prophesee's words), mono (64 bits; from the
lowest: 32 of nanoseconds after time_base, 16 of x, 15 of y, 1 of polarity) and those of iniVation's
cameras (caer_packets) are read.  ROS 1 puts one field behind the other, ROS 2 (CDR) each at a
multiple of its size.
"""

import struct
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from src.recordings.files.caer_packets import decode_compressed_libcaer, decode_libcaer
from src.recordings.files.event_file import RawEvents
from src.recordings.files.evt_decoder import EvtDecoder
from src.recordings.files.frame_files import to_gray

ARRAYS = (
    "dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray", "dv_ros_msgs/msg/EventArray",
)  # fmt: skip
IMAGE = "sensor_msgs/msg/Image"
GRAY, COLOUR = ("mono8", "8UC1"), ("bgr8", "rgb8")  # encodings of images that are read
WORDS = {"evt3": "u2", "mono": "u8", "libcaer": "u4", "libcaer_cmp": "u2"}  # by the encoding
PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
LAST_START_NS = 2**62  # the year 2116
# Places of x, y, seconds, nanoseconds, polarity, and bytes of an event.
ROS1 = (0, 2, 4, 8, 12), 13
FIRST_CDR = (0, 2, 4, 8, 12), 14
NEXT_CDR = (0, 2, 6, 10, 14), 16  # two bytes behind a multiple of four, where the time begins


class EventMessage:
    """A message of type `kind` with events of a camera; `cdr`: of ROS 2.

    `size`: (width, height); `encoding`: of a packet, "" of an array.  Raises struct.error or
    ValueError for bytes that are none.
    """

    def __init__(self, kind: str, content: bytes, cdr: bool):
        self._content, self._cdr, self._at = content, cdr, 4 * cdr
        self._order = ">" if cdr and not content[1] & 1 else "<"
        for _ in range(2 if cdr else 3):  # time, in ROS 1 behind a count
            self._read("I")
        self._read_bytes()  # the frame's name
        height, width = self._read("I"), self._read("I")
        self.size, self.encoding = (width, height), ""
        if kind in PACKETS:
            _, self._start_ns = self._read("Q"), self._read("Q")
            self.encoding = self._read_bytes().rstrip(b"\0").decode()
            self._big = self._read("B")

    def read_events(self, decoder: EvtDecoder) -> RawEvents:
        """Return the events; times in nanoseconds, of evt3 in microseconds, as `decoder` has them.

        Raises ValueError for another encoding.
        """
        if not self.encoding:
            return self._read_array()
        if self.encoding not in WORDS:
            raise ValueError(f"encoding {self.encoding!r} is not read, but {', '.join(WORDS)}")
        big = self._big and self.encoding != "libcaer"  # libcaer's words are little endian
        packed = np.frombuffer(self._read_bytes(), (">" if big else "<") + WORDS[self.encoding])
        if self.encoding == "evt3":
            return decoder.decode(packed.astype("<u2").tobytes())
        if self._start_ns > LAST_START_NS:
            raise ValueError(f"time_base must be in 0..{LAST_START_NS} ns, got {self._start_ns}")
        if self.encoding == "libcaer":
            return decode_libcaer(packed, self._start_ns)
        if self.encoding == "libcaer_cmp":
            return decode_compressed_libcaer(packed, self._start_ns)
        packed = packed.astype(np.uint64)
        t = (packed & 0xFFFFFFFF).astype(np.int64) + self._start_ns
        x, y = (packed >> 32).astype(np.uint16), (packed >> 48).astype(np.uint16)
        return RawEvents(t, x, y & 0x7FFF, y >> 15)

    @property
    def event_bytes(self) -> int:
        """Return how many bytes the events take."""
        return len(self._content) - self._at

    def _read(self, letter: str) -> int:
        """Return a number of struct's `letter`."""
        size = struct.calcsize(f"={letter}")
        if self._cdr:
            self._at += -(self._at - 4) % size
        (value,) = struct.unpack_from(self._order + letter, self._content, self._at)
        self._at += size
        return value

    def _read_bytes(self) -> bytes:
        """Return a string, with the 0 that ends it in ROS 2, or a list of bytes."""
        count = self._read("I")
        self._at += count
        if self._at > len(self._content):
            raise ValueError("a part is longer than its message")
        return self._content[self._at - count : self._at]

    def _read_array(self) -> RawEvents:
        count = self._read("I")
        if not self._cdr:
            return _events(self._table(ROS1, count))
        self._content += b"\0"  # what would lie between the last event and another one
        first = self._table(FIRST_CDR, min(count, 1))
        return _events(np.concatenate([first, self._table(NEXT_CDR, max(count - 1, 0))]))

    def _table(self, layout: tuple[tuple[int, ...], int], count: int) -> np.ndarray:
        """Return `count` events (n,) with the fields x, y, s, ns, p."""
        places, size = layout
        kinds = [self._order + kind for kind in ("u2", "u2", "u4", "u4", "u1")]
        names = ["x", "y", "s", "ns", "p"]
        kind = np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": size})
        table = np.frombuffer(self._content, kind, count, self._at)
        self._at += size * count
        return table


def decode_time_ns_and_gray_image(content: bytes, cdr: bool) -> tuple[int, np.ndarray]:
    """Return the time in nanoseconds and the grey picture (h, w) of a sensor_msgs/Image.

    Raises ValueError for an encoding of other than 8 bits.
    """
    store = _typestore(cdr)
    image: Any = (store.deserialize_cdr if cdr else store.deserialize_ros1)(content, IMAGE)
    if image.encoding not in (*GRAY, *COLOUR):
        known = ", ".join((*GRAY, *COLOUR))
        raise ValueError(f"images of encoding {image.encoding} are not read, but {known}")
    depth = 3 if image.encoding in COLOUR else 1
    rows = image.data.reshape(image.height, image.step)[:, : image.width * depth]
    picture = to_gray(rows.reshape(image.height, image.width, depth), image.encoding == "rgb8")
    stamp = image.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec, picture


@lru_cache
def _typestore(cdr: bool) -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE if cdr else Stores.ROS1_NOETIC)


def _events(table: np.ndarray) -> RawEvents:
    t = table["s"].astype(np.int64) * 1_000_000_000 + table["ns"]
    return RawEvents(t, table["x"].astype(np.uint16), table["y"].astype(np.uint16), table["p"])
