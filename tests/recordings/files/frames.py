"""Recordings with a camera's frames in the layouts of data sets, made small."""

import json
from pathlib import Path

import cv2
import h5py
import numpy as np

from src.recordings.files.event_file import EVENT
from tests.recordings.files.bags import Bag

SIZE = (40, 48)  # height, width
START_US = 2_000_000  # of the clock; the first frame comes before the first event
FRAME_US = np.array([0, 30_000, 60_000, 90_000, 120_000]) + START_US
LAYOUTS = ("ecd", "timelens", "bs_ergb", "mvsec", "event_cnn_minimal", "bag", "bag2", "evreal")


def make_events(count: int = 3000, seed: int = 0) -> np.ndarray:
    """Return events (count,) from 0.01 s to 0.1 s behind the first frame."""
    g = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(g.integers(10_000, 100_000, count)) + START_US
    events["x"], events["y"] = g.integers(0, SIZE[1], count), g.integers(0, SIZE[0], count)
    events["p"] = g.choice([-1, 1], count)
    return events


def make_frames(count: int = len(FRAME_US)) -> np.ndarray:
    """Return frames (count, h, w) of 8 bits: waves, another in each."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    waves = [128 + 90 * np.sin(0.3 * x + 0.2 * k * y + k) for k in range(count)]
    return np.stack(waves).astype(np.uint8)


def write_recording(folder: Path, layout: str, events: np.ndarray, frames: np.ndarray) -> Path:
    """Write a recording into `folder`, a new one; return what is given as recording=."""
    folder.mkdir(parents=True)
    return WRITERS[layout](folder, events, frames)


def _ecd(folder: Path, events: np.ndarray, frames: np.ndarray) -> Path:
    table = np.stack([events["t"] * 1e-6, events["x"], events["y"], events["p"] > 0], 1)
    np.savetxt(folder / "events.txt", table, fmt="%.9f %d %d %d")
    names = _pictures(folder / "images", frames)
    lines = [f"{t * 1e-6:.9f} images/{name}\n" for t, name in zip(FRAME_US, names, strict=False)]
    (folder / "images.txt").write_text("".join(lines))
    return folder / "events.txt"


def _timelens(folder: Path, events: np.ndarray, frames: np.ndarray) -> Path:
    return _numbered(folder, events, frames, dict(zip("xytp", "xytp", strict=True)), 1)


def _bs_ergb(folder: Path, events: np.ndarray, frames: np.ndarray) -> Path:
    keys = {"x": "x", "y": "y", "t": "timestamp", "p": "polarity"}
    return _numbered(folder, events, frames, keys, 32)


def _numbered(folder: Path, events, frames, keys: dict[str, str], scale: int) -> Path:
    (folder / "events").mkdir()
    for k, part in enumerate(np.split(events, [1000, 1000, 2500])):  # the second is empty
        columns = {keys[name]: part[name] for name in "xytp"}
        for side in (keys["x"], keys["y"]):
            columns[side] = (columns[side].astype(int) * scale - scale // 4).astype(np.uint16)
        columns[keys["p"]] = columns[keys["p"]] > 0
        np.savez(folder / "events" / f"{k + 8}.npz", **columns)  # 10 comes after 9
    _pictures(folder / "images", frames)
    np.savetxt(folder / "images" / "timestamp.txt", FRAME_US[: len(frames)], "%d")
    return folder


def _mvsec(folder: Path, events: np.ndarray, frames: np.ndarray) -> Path:
    with h5py.File(folder / "cap_data.hdf5", "w") as file:
        left = file.create_group("davis/left")
        left["events"] = np.stack([events["x"], events["y"], events["t"] * 1e-6, events["p"]], 1)
        left["image_raw"], left["image_raw_ts"] = frames, FRAME_US[: len(frames)] * 1e-6
    return folder / "cap_data.hdf5"


def _event_cnn_minimal(folder: Path, events: np.ndarray, frames: np.ndarray) -> Path:
    with h5py.File(folder / "cap.h5", "w") as file:
        for name, column in zip("xytp", ("xs", "ys", "ts", "ps"), strict=True):
            file[f"events/{column}"] = events[name] * 1e-6 if name == "t" else events[name]
        for k, (time, frame) in enumerate(zip(FRAME_US, frames, strict=False)):
            file[f"images/image{k:09d}"] = frame
            file[f"images/image{k:09d}"].attrs["timestamp"] = time * 1e-6
    return folder / "cap.h5"


def _bag(folder: Path, events: np.ndarray, frames: np.ndarray, plugin: str | None = None) -> Path:
    path, parts = folder / f"cap{'' if plugin else '.bag'}", events.copy()
    parts["t"] *= 1000
    with Bag(path, plugin) as bag:
        for part in np.array_split(parts, 4):
            bag.add_array("/dvs/events", part, size=SIZE)
        for k, (time, frame) in enumerate(zip(FRAME_US, frames, strict=False)):
            bag.add_image("/dvs/image_raw", frame, int(time) * 1000, ("mono8", "bgr8")[k % 2])
            bag.add_image("/other/image_raw", 255 - frame, 5, "mono8")
    return path


def _evreal(folder: Path, events: np.ndarray, frames: np.ndarray) -> Path:
    zero, times = FRAME_US[0], FRAME_US[: len(frames), None]
    arrays = {
        "events_ts": (events["t"] - zero) * 1e-6, "events_p": events["p"] > 0,
        "events_xy": np.stack([events["x"], events["y"]], 1).astype(np.int16),
        "images": frames[..., None], "images_ts": (times - zero) * 1e-6,
        "image_event_indices": (np.searchsorted(events["t"], times, "right") - 1).clip(0),
    }  # fmt: skip
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    (folder / "metadata.json").write_text(json.dumps({"sensor_resolution": SIZE}))
    return folder


def _pictures(folder: Path, frames: np.ndarray) -> list[str]:
    folder.mkdir()
    names = [f"frame{k + 8}.png" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(str(folder / name), frame)
    return names


WRITERS = {
    "ecd": _ecd, "timelens": _timelens, "bs_ergb": _bs_ergb, "mvsec": _mvsec, "bag": _bag,
    "event_cnn_minimal": _event_cnn_minimal, "evreal": _evreal,
    "bag2": lambda folder, events, frames: _bag(folder, events, frames, "sqlite3"),
}  # fmt: skip
