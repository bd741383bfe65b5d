"""Inputs of known size: events of a recording, a picture of the sensor."""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float

from src.recordings.files import recording
from src.recordings.files.event_file import HeightWidth, ReadOptions
from src.recordings.files.hdf5_file import HDF5_ENDINGS, check_hdf5_safety, find_streams
from src.recordings.files.recorded_frames import find_frames
from src.recordings.files.videos import read_gray_picture, read_video
from src.recordings.views import Views, load_views, views_or_whole_sensor
from src.sim.scenes.video_files import PICTURE_SUFFIXES, VIDEO_SUFFIXES


def find_views(
    path: Path | str,
    views: Path | str | None,
    sensor: Sequence[int] | None = None,
    options: ReadOptions = ReadOptions(),
    resolution: Sequence[int] | None = None,
) -> Views:
    """Return the views of the file `views` on the sensor of the recording at `path`, or all of it
    as one view; raises ValueError as `find_sensor_size` and `views_or_whole_sensor` do."""
    in_views = None if views is None else load_views(views).sensor
    size = find_sensor_size(path, sensor, options, in_views)
    return views_or_whole_sensor(views, size, resolution)


def find_sensor_size(
    path: Path | str,
    sensor: Sequence[int] | None = None,
    options: ReadOptions = ReadOptions(),
    in_views: HeightWidth | None = None,
) -> HeightWidth:
    """Return (height, width) of the recording's sensor: `sensor`, else what the file states, else
    that of its views, else that of the frames beside its events, with a warning.

    Raises ValueError where none says.
    """
    opened = recording.open_recording(path, sensor, options)
    if opened.size is not None:
        return opened.size[::-1]
    if in_views is not None:
        return in_views
    try:
        frames = find_frames(opened)
    except (ValueError, OSError):  # pictures that cannot be read, or a listing of something else
        frames = None
    if frames is None:
        raise ValueError(f"{path} does not state its sensor; give sensor_size=[height,width]")
    height, width = frames.size
    warnings.warn(f"{path}: a sensor of {width}x{height}, as its frames", stacklevel=2)
    return frames.size


def iter_recording(
    path: Path | str,
    sensor: HeightWidth,
    seconds: float = 0.05,
    options: ReadOptions = ReadOptions(),
) -> Iterator[np.ndarray]:
    """Yield the events of a recording, `seconds` at a time; raises ValueError where it has none."""
    events = None
    chunks = recording.iter_events(path, seconds=seconds, sensor_size=sensor, options=options)
    for events in chunks:
        yield events
    if events is None:
        raise ValueError(f"{path}: holds no events")


def read_picture_or_event_counts(
    path: Path | str, sensor: Sequence[int] | None = None, options: ReadOptions = ReadOptions()
) -> Float[np.ndarray, "h w"]:
    """Return a picture in [0, 1], the mean of a film, or the number of events of each pixel, which
    shows a target that blinks on a dark screen.  Raises ValueError for what cannot be read."""
    path = Path(path)
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return read_gray_picture(path)
    if not has_events(path):
        frames = read_video(path)
        total, count = next(frames), 1
        for frame in frames:
            total, count = total + frame, count + 1
        return total / count
    counts = np.zeros(find_sensor_size(path, sensor, options))
    for chunk in iter_recording(path, counts.shape, options=options):
        pixels = np.ravel_multi_index((chunk["y"], chunk["x"]), counts.shape)
        counts += np.bincount(pixels, minlength=counts.size).reshape(counts.shape)
    return counts


def has_events(path: Path | str) -> bool:
    """Return whether `path` is none of: folder of pictures, picture, film, our `video.h5`.  Of HDF5
    with `frames` and events these are read: a warning says so."""
    path = Path(path)
    if path.is_dir() or path.suffix.lower() in PICTURE_SUFFIXES | VIDEO_SUFFIXES:
        return recording.find_folder_reader(path) is not None
    if path.suffix.lower() not in HDF5_ENDINGS:
        return True
    try:
        with h5py.File(path) as file:
            if "frames" not in file:
                return True
            check_hdf5_safety(file)
            has_streams = bool(find_streams(file))
    except (OSError, ValueError):  # said when it is read
        return True
    if has_streams:
        warnings.warn(f"{path} holds events and frames: its events are used", stacklevel=1)
    return has_streams or path.suffix.lower() != ".h5"
