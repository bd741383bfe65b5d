"""A recording to another format: python -m src.convert recording=cap.raw out=cap.h5."""

import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from src.app import entry_point
from src.recordings.event_windows import check_time_range
from src.recordings.files import event_writers, recording, recording_inputs
from src.recordings.files.event_arrays import count_before
from src.recordings.files.event_file import HeightWidth, ReadOptions
from src.recordings.files.recorded_frames import RecordedFrames, find_frames
from src.records.atomic import check_writable, partial_path


def convert(cfg: DictConfig) -> Path:
    """Write the events of `cfg.recording` from `start_s` to `end_s` to `cfg.out`; return it.

    Raises ValueError for a recording that cannot be read, a format that cannot be written or cannot
    hold it, an `out` that cannot be made, and where it would be the recording or lie in its folder.
    """
    source, out = Path(cfg.recording), Path(cfg.out)
    for written in (out, partial_path(out)):
        if written.exists() and source.exists() and written.samefile(source):
            raise ValueError(f"out must be another file than recording, got {out}")
    if source.is_dir() and out.resolve().is_relative_to(source.resolve()):
        raise ValueError(f"out must lie outside the folder recording={source}, got {out}")
    options = ReadOptions.from_keys(cfg)
    height, width = recording_inputs.find_sensor_size(source, cfg.sensor_size, options)
    how = {"width": width, "height": height, "version": cfg.version, "layout": cfg.layout}
    event_writers.choose_file_kind(out, **how, config_key="out")
    opened = recording.open_recording(source, (height, width), options)
    frames = (
        find_frames_to_convert(opened, (height, width), cfg) if cfg.layout == "evreal" else None
    )
    events = cut_time_range(opened, cfg.start_s, cfg.end_s)
    if cfg.layout != "evreal":  # its clock starts at 0 with the first event or frame
        events = shift_negative_times(events)
    check_writable(out, "out")
    count, seconds = event_writers.write_pieces(out, events, **how, frames=frames)
    size = sum(file.stat().st_size for file in (out, *out.rglob("*")) if file.is_file())
    print(f"{count} events, {seconds:.6f} s, {width}x{height}, {size} bytes: {out}")
    return out


def find_frames_to_convert(
    opened: recording.EventRecording, sensor: HeightWidth, cfg: DictConfig
) -> RecordedFrames | None:
    """Return the frames of a recording from `start_s` on; None, with a warning, for frames of
    another size than the sensor's."""
    frames = find_frames(opened)
    if frames is None:
        return None
    if frames.size != sensor:
        (height, width), (wanted_height, wanted_width) = frames.size, sensor
        found = f"{opened.path}: frames of {width}x{height} are left out"
        warnings.warn(f"{found}, the sensor is {wanted_width}x{wanted_height}", stacklevel=2)
        return None
    if cfg.start_s:
        first = next((int(events["t"][0]) for events in opened), 0)
        frames = frames.select(frames.times_us >= first + cfg.start_s * 1e6)
    return frames if len(frames.times_us) else None


def cut_time_range(
    pieces: Iterable[np.ndarray], start_s: float, end_s: float
) -> Iterator[np.ndarray]:
    """Yield the events from `start_s` to `end_s`, seconds after the first of `pieces`."""
    check_time_range(start_s, end_s)
    first, count = None, 0
    for events in filter(len, pieces):
        first = int(events["t"][0]) if first is None else first
        end = count_before(events, first + end_s * 1e6)
        part = events[count_before(events, first + start_s * 1e6) : end]
        count += len(part)
        yield part
        if end < len(events):
            break
    if not count:
        raise ValueError(f"recording must have events from {start_s} s to {end_s} s, got none")


def shift_negative_times(pieces: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the events, from 0 on where the first has a negative time, with a warning."""
    shift_us = None
    for events in filter(len, pieces):
        if shift_us is None:
            shift_us = max(0, -int(events["t"][0]))
            if shift_us:
                line = f"times begin at {-shift_us} us, written are those {shift_us} us later"
                warnings.warn(line, stacklevel=2)
        if shift_us:
            events = events.copy()
            events["t"] += shift_us
        yield events


if __name__ == "__main__":
    entry_point.run_command(convert, "convert")
