"""Files that appear whole or not at all: written under a temporary name, then renamed."""

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LEAST_FREE_BYTES = 32 * 2**20
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield the temporary path to write to, in the folder of `path`, which is created.

    After the block that file is synced and renamed to `path`; where the block fails it is removed.
    The process id in its name keeps two writers of one file apart.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def check_writable(path: Path, key: str) -> None:
    """Raise ValueError, which names `key`, where no file can be made in the folder of `path`, which
    is created."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        wanted = f"{key} must be a path that can be written"
        raise ValueError(f"{wanted}, got {path}: {error.strerror}") from error


def check_free_space(folder: Path) -> None:
    """Raise OSError where the disk of `folder` is nearly full.

    HDF5's library crashes where it cannot write, which a quota or `ulimit -f` can still cause.
    """
    if shutil.disk_usage(folder).free < LEAST_FREE_BYTES:
        raise OSError(
            errno.ENOSPC, f"No space left beyond {LEAST_FREE_BYTES >> 20} MiB", str(folder)
        )


@contextmanager
def name_path_in_errors(path: Path) -> Iterator[None]:
    """Raise the errors of a full disk that name no file with `path`."""
    try:
        yield
    except OSError as error:
        if error.errno not in FULL or error.filename is not None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error


def partial_path(path: Path) -> Path:
    """Return the name of a file or folder while it is written: `cap.partial.raw`."""
    return path.with_name(f"{path.stem}.partial{path.suffix}")


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path`, whole or not at all."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")
