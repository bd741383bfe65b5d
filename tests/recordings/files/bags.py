"""Bags with events, written by rosbags: its serializer is what the reader is checked against."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EVENT = "uint16 x\nuint16 y\n{time} ts\nbool polarity\n"
ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\n{name}/Event[] events\n"
PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events\n"
)
ARRAYS = ("dvs_msgs", "prophesee_event_msgs", "dv_ros_msgs")
PACKETS = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")


class Bag:
    """A bag that is written; `plugin` of ROS 2 is sqlite3 or mcap, None: ROS 1."""

    def __init__(self, path: Path, plugin: str | None, packing: str | None = None):
        self.ros2 = plugin is not None
        self.store = get_typestore(Stores.ROS2_HUMBLE if self.ros2 else Stores.ROS1_NOETIC)
        time = "builtin_interfaces/Time" if self.ros2 else "time"
        texts = {f"{name}/msg/Event": EVENT.format(time=time) for name in ARRAYS}
        texts |= {f"{name}/msg/EventArray": ARRAY.format(name=name) for name in ARRAYS}
        for kind, text in (texts | dict.fromkeys(PACKETS, PACKET)).items():
            self.store.register(get_types_from_msg(text, kind))
        if plugin:
            self.writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin[plugin.upper()])
        else:
            self.writer = Ros1Writer(path)
        if packing:
            how = (
                (CompressionMode[packing.upper()], CompressionFormat.ZSTD)
                if plugin
                else (Ros1Writer.CompressionFormat[packing.upper()],)
            )
            self.writer.set_compression(*how)
        self.links: dict[str, object] = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *error):
        self.writer.close()

    def add(self, topic: str, kind: str, message: object, time_ns: int = 1) -> None:
        if topic not in self.links:
            self.links[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_cdr if self.ros2 else self.store.serialize_ros1
        self.writer.write(self.links[topic], time_ns, serialize(message, kind))

    def header(self, frame: str = "camera"):
        types = self.store.types
        time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
        extra = {} if self.ros2 else {"seq": 3}
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **extra)

    def add_image(self, topic: str, picture: np.ndarray, time_ns: int, encoding: str) -> None:
        """Add a grey picture (h, w) as sensor_msgs/Image, its rows two bytes longer than needed."""
        header, kind = self.header(), "sensor_msgs/msg/Image"
        header.stamp.sec, header.stamp.nanosec = divmod(time_ns, 10**9)
        depth = 3 if encoding == "bgr8" else 1
        rows = np.pad(picture.repeat(depth, axis=1), [(0, 0), (0, 2)])
        (height, width), step = picture.shape, rows.shape[1]
        message = self.store.types[kind](
            header=header, height=height, width=width, encoding=encoding, is_bigendian=0,
            step=step, data=rows.ravel(),
        )  # fmt: skip
        self.add(topic, kind, message, time_ns)

    def add_array(
        self, topic: str, events: np.ndarray, name: str = "dvs_msgs", frame="camera",
        size=(480, 640),
    ):  # fmt: skip
        """Add events, times in nanoseconds, as one message of `name`/EventArray."""
        types = self.store.types
        Event, Time = types[f"{name}/msg/Event"], types["builtin_interfaces/msg/Time"]
        listed = [
            Event(x=int(x), y=int(y), ts=Time(*divmod(int(t), 10**9)), polarity=bool(p > 0))
            for t, x, y, p in events.tolist()
        ]
        kind = f"{name}/msg/EventArray"
        height, width = size
        message = types[kind](header=self.header(frame), height=height, width=width, events=listed)
        self.add(topic, kind, message, int(events["t"][0]) if len(events) else 1)

    def add_packet(
        self, topic: str, content: bytes, encoding: str, base=0, big=False, kind=PACKETS[0]
    ):
        message = self.store.types[kind](
            header=self.header(), height=480, width=640, seq=1, time_base=base, encoding=encoding,
            is_bigendian=big, events=np.frombuffer(content, np.uint8),
        )  # fmt: skip
        self.add(topic, kind, message, len(self.links) + 1)
