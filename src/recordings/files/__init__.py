"""Recordings of event cameras: `read_events(path)` returns the events of a file of any format."""

from src.recordings.files.event_file import EVENT, ReadOptions
from src.recordings.files.recording import iter_events, open_recording, read_events

__all__ = ["EVENT", "ReadOptions", "iter_events", "open_recording", "read_events"]
