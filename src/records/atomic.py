"""Files that are whole or not there: written beside under a temporary name, then renamed.

The name has the process in it, so that of two that write the same file neither takes the other's.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Yield the name to write to, in the folder of `path`, which is made.

    At the end of the block that file becomes `path`, on the disk when this returns; where the block
    fails it is removed, and what was at `path` before stays.
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


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path`, whole or not at all."""
    with written(path) as partial:
        partial.write_text(text)
