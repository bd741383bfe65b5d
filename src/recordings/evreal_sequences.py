"""Sequences of events and frames below a folder, in EVREAL's layout or brought to it."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from src.recordings.files import event_writers, recording
from src.recordings.files.evreal_folder import EvrealSequence, is_evreal_folder, open_sequence
from src.recordings.files.recorded_frames import find_frames

FILES = (".bag", ".h5", ".hdf5")  # that may hold events and frames
TEXTS = (".txt", ".zip", ".gz")


def find_sequences(root: str | None) -> list[Path]:
    """Return the recordings with frames at or below `root`, by path.

    Raises ValueError where there are none.
    """
    if root is None or not Path(root).exists():
        raise ValueError(f"scene.root must be a folder of sequences, got {root}")
    found = list(_walk(Path(root)))
    if not found:
        wanted = "sequences of EVREAL, or recordings with frames (docs/benchmarks.md)"
        raise ValueError(f"scene.root must hold {wanted}, got none in {root}")
    return found


def _walk(path: Path) -> Iterator[Path]:
    if _is_sequence(path):
        yield path
    elif path.is_dir():
        for inner in sorted(path.iterdir()):
            if not inner.name.startswith("."):
                yield from _walk(inner)


def _is_sequence(path: Path) -> bool:
    if path.is_dir():
        is_listed = (path / "images.txt").is_file()
        return is_listed or recording.find_folder_reader(path) is not None
    return path.suffix.lower() in FILES and not path.stem.endswith("_gt")  # MVSEC's depth


def sequence_name(source: Path) -> str:
    """Return the name of a sequence: that of its folder, or of its file without the ending."""
    return source.resolve().name if source.is_dir() else source.stem


@contextmanager
def open_as_evreal(source: Path, run: Path) -> Iterator[EvrealSequence]:
    """Open a sequence; what is not in EVREAL's layout is written so below `run` for a while.

    Raises ValueError for a recording without events or frames, or with frames of another size.
    """
    if is_evreal_folder(source):
        yield open_sequence(source)
        return
    path = source if recording.find_folder_reader(source) or source.is_file() else _text(source)
    opened = recording.open_recording(path)
    frames = find_frames(opened)
    if frames is None:
        raise ValueError(f"{path}: holds events but no frames")
    height, width = frames.size
    if opened.size not in (None, (width, height)):
        raise ValueError(f"{path}: frames are {(height, width)}, the sensor {opened.size[::-1]}")
    opened = recording.open_recording(path, (height, width))
    with tempfile.TemporaryDirectory(dir=run, prefix=".sequence") as folder:
        out = Path(folder) / sequence_name(source)
        event_writers.write_pieces(
            out, opened, width=width, height=height, layout="evreal", frames=frames
        )
        yield replace(open_sequence(out), path=path)


def _text(folder: Path) -> Path:
    """Return the text of events in a folder with images.txt: events.txt, or the only events*."""
    found = [path for path in folder.glob("events*") if path.suffix in TEXTS]
    named = [path for path in found if path.name == "events.txt"] or found
    if len(named) != 1:
        raise ValueError(f"{folder}: events.txt is missing, {len(found)} other files of events")
    return named[0]
