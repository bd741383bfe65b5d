"""Files of PyTorch that are whole or not there: how they are written, and the newest checkpoint."""

import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch

from src.records.atomic import atomic_path


def save_atomically(content: Any, path: Path) -> None:
    """Write `content` as torch.save does; it is on the disk, whole, when this returns, and an
    OSError leaves what was there before.
    """
    with atomic_path(path) as partial, partial.open("wb") as file:
        torch.save(content, file)


def is_intact(path: Path) -> bool:
    """Return whether every part of a checkpoint has the checksum it was written with.

    PyTorch's own reader does not look at them: a flipped bit would go unnoticed.
    """
    try:
        if is_compressed_zip(path):
            return False
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError, EOFError):
        return False


def is_compressed_zip(path: Path) -> bool:
    """Return whether a zip file gives more bytes than it has, as none does that PyTorch wrote: it
    packs nothing, and a small file that is packed could fill the memory.
    """
    with zipfile.ZipFile(path) as archive:
        return sum(part.file_size for part in archive.infolist()) > path.stat().st_size


def list_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a run or of a folder of runs, such as out/train/lf3x3: `*.ckpt` in
    `folder`, in its `checkpoints/` and in those of each run in it, which holds a `config.yaml`."""
    runs = [config.parent for config in folder.glob("*/config.yaml")]
    places = [folder, folder / "checkpoints", *(run / "checkpoints" for run in runs)]
    return [path for place in places for path in place.glob("*.ckpt")]


def newest_checkpoint(run: Path) -> Path:
    """Return the newest whole checkpoint of `list_checkpoints`; warns of damaged ones, and where
    folders of several runs are there.

    Raises ValueError, beginning with `ckpt`, where there is none.
    """
    paths = sorted(list_checkpoints(run), key=lambda path: path.stat().st_mtime_ns)[::-1]
    runs = len({path.parent for path in paths})
    for path in paths:
        if is_intact(path):
            if runs > 1:
                warnings.warn(f"{run} holds {runs} runs, the newest is taken: {path}", stacklevel=2)
            return path
        warnings.warn(f"{path} is damaged, an older checkpoint is taken", stacklevel=2)
    raise ValueError(f"ckpt must be a folder with a whole checkpoint, got none in {run}")
