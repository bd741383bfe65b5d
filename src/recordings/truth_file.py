"""What a simulated recording shows, beside it: `cap.truth.h5` (HDF5, gzip).

    clean      (frames, h, w) uint8             grey code values, without turbulence
    views      (views, frames, h, w) uint8      the same moments as every view shows them
    tilt       (views, frames, 2, h, w) float16 displacement (x, y) in pixels, to 1/32
    time_s     (frames,) float64                clock of the events; 0: the first frame
    positions  (views, 2) int64                 (row, col) of every view from the centre view

Attributes: `fps` of these frames, and what was drawn: contrast threshold, severity ...
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from src import COMMAND
from src.recordings.files.event_file import HeightWidth
from src.recordings.output import resize_picture, round_to_uint8
from src.recordings.views import Views
from src.records.atomic import atomic_path

TILT_STEPS_PER_PX = 32  # what is left out is below the error of the simulated tilt


class TruthWriter:
    """Takes the frames of a clip, some at a time."""

    def __init__(self, file: h5py.File, views: int, frames: int, size: HeightWidth):
        self.file, self.written = file, 0
        gzip: dict[str, Any] = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
        for name, shape, kind, chunk in (
            ("clean", (frames, *size), np.uint8, (1, *size)),
            ("views", (views, frames, *size), np.uint8, (1, 1, *size)),
            ("tilt", (views, frames, 2, *size), np.float16, (1, 1, 1, *size)),
        ):
            file.create_dataset(name, shape, kind, chunks=chunk, **gzip)

    def add(
        self, clean: Float[Tensor, "part h w"], views: Float[Tensor, "views part h w"],
        tilt: Float[Tensor, "views part 2 h w"],
    ) -> None:  # fmt: skip
        """Write the next frames: code values in [0, 1] and pixels."""
        at = slice(self.written, self.written + len(clean))
        self.file["clean"][at] = round_to_uint8(clean.numpy())
        self.file["views"][:, at] = round_to_uint8(views.numpy())
        self.file["tilt"][:, at] = (
            ((tilt * TILT_STEPS_PER_PX).round() / TILT_STEPS_PER_PX).half().numpy()
        )
        self.written = at.stop


@contextmanager
def create_truth_file(
    recording: Path, views: Views, frames: int, fps: float, facts: Mapping[str, Any]
) -> Iterator[TruthWriter]:
    """Open the truth beside `recording`, a clip of `frames` frames at `fps`; `facts`: attributes.

    The file is there when the block has ended, and only then.
    """
    path = recording.with_suffix(".truth.h5")
    with atomic_path(path) as partial, h5py.File(partial, "w") as file:
        file["time_s"] = np.arange(frames) / fps
        file["positions"] = np.array(views.positions, np.int64)
        file.attrs.update({"fps": fps, **facts})
        yield TruthWriter(file, len(views.positions), frames, views.model)


@dataclass(frozen=True, eq=False)
class CleanClip:
    """`frames` (frames, h, w) uint8 at `times_s`, on the clock of the events."""

    frames: UInt8[np.ndarray, "frames h w"]
    times_s: Float[np.ndarray, " frames"]

    def nearest_frame(self, time_s: float, size: tuple[int, ...]) -> Float[np.ndarray, "h w"]:
        """Return the frame nearest to `time_s`, in [0, 1], brought to `size` (h, w)."""
        frame = self.frames[int(np.abs(self.times_s - time_s).argmin())].astype(np.float32) / 255
        return resize_picture(frame, size).clip(0, 1)


def read_clean_clip(recording: Path) -> CleanClip | None:
    """Return the clean clip beside a simulated recording; None where there is no such file."""
    path = recording.with_suffix(".truth.h5")
    if not path.is_file():
        return None
    try:
        with h5py.File(path) as file:
            return CleanClip(file["clean"][:], file["time_s"][:])
    except (OSError, KeyError) as error:
        wanted = f"the truth that `{COMMAND}simulate` writes"
        raise ValueError(f"{path} must be {wanted}: {error}") from None
