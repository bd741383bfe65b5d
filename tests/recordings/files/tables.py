"""Event files of any kind, tables too, which the program reads but does not write."""

import warnings
from pathlib import Path

import h5py
import numpy as np

from src.recordings.files import ReadOptions, event_writers, read_events

TABLES = (".txt", ".csv", ".npz", ".h5", ".hdf5")


def write_events(
    path: Path, events: np.ndarray, *, width: int, height: int, version: str | None = None
) -> None:
    """Write events (t x y p) in the format of the path's ending."""
    if path.suffix in TABLES:
        write_table(path, events, (width, height))
    else:
        event_writers.write_events(path, events, width=width, height=height, version=version)


def write_table(path: Path, events: np.ndarray, size: tuple[int, int]) -> None:
    """Write the events with the sensor's (width, height); times in microseconds."""
    data = {name: events[name] for name in "txyp"}
    if path.suffix == ".npz":
        np.savez_compressed(path, **data, size=np.array(size))
    elif path.suffix in (".h5", ".hdf5"):
        with h5py.File(path, "w") as file:
            file.attrs["size"] = size
            for name, column in data.items():
                file.create_dataset(f"events/{name}", data=column, chunks=True, compression="gzip")
            t = events["t"]
            if len(t):
                marks = np.searchsorted(t, np.arange(0, t[-1] // 1000 + 2) * 1000)
                file["ms_to_idx"] = marks.astype(np.uint64)
    else:
        comma = "," if path.suffix == ".csv" else " "
        header = comma.join(["t", f"x@{size[0]}", f"y@{size[1]}", "p"])
        table = np.stack([column.astype(np.int64) for column in data.values()], 1)
        np.savetxt(path, table, fmt="%d", delimiter=comma, header=header, comments="")


def quiet_read(path: Path, **options) -> np.ndarray:
    """Return the events; a warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_events(path, options=ReadOptions(**options))
