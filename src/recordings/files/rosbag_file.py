"""Bags of ROS 1 (.bag) and ROS 2 (a folder with metadata.yaml, .db3, .mcap), by rosbags.

Each topic of events is a stream.  Times are those of the events, not of the messages.
"""

import warnings
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from functools import partial
from itertools import islice
from os.path import commonpath
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from src.recordings.files.blocks import merge_small_pieces
from src.recordings.files.event_file import (
    EventFile,
    EventStream,
    RawEvents,
    RawFrames,
    ReadOptions,
    choose_stream,
    name_file_in_errors,
)
from src.recordings.files.evt_decoder import EvtDecoder
from src.recordings.files.ros_messages import (
    ARRAYS,
    IMAGE,
    PACKETS,
    EventMessage,
    decode_time_ns_and_gray_image,
)
from src.recordings.files.unpacking import decompress

READERS: dict[str, Any] = {".bag": Ros1Reader, ".db3": Sqlite3Reader, ".mcap": mcap.McapReader}
Messages = Generator[tuple[str, EventMessage], None, None]  # of a topic, its name first
SIZE_MESSAGES = 100  # the first ones, of which one may state the sensor's size
ZSTD = b"\x28\xb5\x2f\xfd"  # how a message begins that is packed alone

# rosbags itself unpacks without bound.
ros1.decompressors.update({kind: partial(decompress, kind=kind) for kind in ("lz4", "bz2")})
mcap.DECOMPRESSORS.update(
    lz4=lambda packed, _: decompress(packed, "lz4"),
    zstd=lambda packed, _: decompress(packed, "zstd"),
)


def is_bag_folder(path: Path) -> bool:
    """Return whether `path` is a bag of ROS 2, a folder."""
    return (path / "metadata.yaml").is_file()


class RosbagFile(EventFile):
    """A bag; times are nanoseconds, of Prophesee's words microseconds.

    `options.stream` is the place or the name of one of several topics of events, by default the one
    with most bytes.  Raises ValueError for a bag that cannot be read or holds no events.
    """

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        self._ros2 = path.is_dir() or path.suffix.lower() != ".bag"
        topics = self._find_topics()
        sizes = self._count_bytes() if len(topics) > 1 and options.stream is None else {}
        most = max(range(len(topics)), key=lambda place: sizes.get(topics[place], 0))
        streams = [EventStream(place, topic, None) for place, topic in enumerate(topics)]
        chosen, self.notes = choose_stream(path, streams, options.stream, most)
        self._topic = chosen.name
        first = None
        with closing(self._messages(self._topic)) as messages:
            for _, message in islice(messages, SIZE_MESSAGES):
                first = first or message
                if all(message.size):
                    self.size = message.size
                    break
        if first is None:
            raise ValueError(f"{path}: topic {self._topic} holds no messages")
        self._encoding = first.encoding
        self.time_unit = "us" if first.encoding == "evt3" else "ns"

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; warns of events before the first time; raises ValueError for a message
        that cannot be read."""
        decoder = EvtDecoder("evt3")
        yield from merge_small_pieces(self._events(decoder))
        if decoder.lost:
            warnings.warn(
                f"{self.path}: {decoder.lost} events before the first time, dropped", stacklevel=2
            )

    def frames(self) -> RawFrames | None:
        """Return the images of the topic whose name is most like that of the events, such as
        /dvs/image_raw beside /dvs/events; None for events without the bag's clock."""
        with self._opened() as reader:
            links = [link for link in reader.connections if link.msgtype == IMAGE]
        topics = {link.topic for link in links if link.msgcount}
        if not topics or self._encoding == "evt3":
            return None
        topic = max(
            sorted(topics), key=lambda name: len(commonpath([f"/{name}", f"/{self._topic}"]))
        )

        def images() -> Iterator[tuple[int, np.ndarray]]:
            for _, content in self._contents((IMAGE,), topic):
                yield decode_time_ns_and_gray_image(content, self._ros2)

        _, first = next(images())
        times = np.array([time for time, _ in images()])
        return RawFrames(times, first.shape, lambda: (picture for _, picture in images()), "ns")

    def _events(self, decoder: EvtDecoder) -> Iterator[RawEvents]:
        with name_file_in_errors(self.path, f"topic {self._topic}"):
            for _, message in self._messages(self._topic):
                if message.encoding != self._encoding:
                    raise ValueError(f"encoding changes to {message.encoding}")
                yield message.read_events(decoder)

    def _find_topics(self) -> list[str]:
        with self._opened() as reader:
            topics = {link.topic: link.msgtype for link in reader.connections if link.msgcount}
        found = sorted(topic for topic, kind in topics.items() if kind in (*ARRAYS, *PACKETS))
        if not found:
            others = ", ".join(sorted(set(topics.values()))[:5]) or "nothing"
            raise ValueError(f"{self.path}: holds no messages of events, only {others}")
        return found

    def _count_bytes(self) -> Counter:
        sizes: Counter = Counter()
        for topic, message in self._messages():
            sizes[topic] += message.event_bytes
        return sizes

    def _messages(self, topic: str | None = None) -> Messages:
        """Yield the messages of a topic, or of all topics of events, with its name."""
        with closing(self._contents((*ARRAYS, *PACKETS), topic)) as contents:
            for link, content in contents:
                yield link.topic, EventMessage(link.msgtype, content, self._ros2)

    def _contents(
        self, kinds: tuple[str, ...], topic: str | None
    ) -> Generator[tuple[Any, bytes], None, None]:
        """Yield the bytes of the messages of some types, of one topic or of all."""
        with self._opened() as reader:
            for part in getattr(reader, "storages", [reader]):  # the files of a folder
                links = [link for link in part.connections if link.msgtype in kinds]
                wanted = [link for link in links if topic in (None, link.topic)]
                for link, _, content in part.messages(wanted) if wanted else ():
                    packed = content[:4] == ZSTD
                    yield link, decompress(content, "zstd") if packed else content

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        """Open the bag; what rosbags raises of a broken one, of all kinds, names the file."""
        kind = DirectoryReader if self.path.is_dir() else READERS[self.path.suffix.lower()]
        with name_file_in_errors(self.path, "cannot be read as a bag"):
            reader = kind(self.path)
            reader.open()
            with closing(reader):
                yield reader
