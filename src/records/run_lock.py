"""The lock of a run's folder: two processes at once would mix their files."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

HELD = (errno.EAGAIN, errno.EACCES)
# Above 0 in all but the first of several processes that train together, which share a folder.
RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "SLURM_PROCID")


@contextmanager
def hold_run_folder(run: Path) -> Iterator[None]:
    """Keep the folder `run`, which is there, from other processes within the block.

    The system frees it when the process ends, however that is; forked processes do not hold it.
    Raises ValueError where another process holds it.  On a disk without locks nothing is held.
    """
    if any(os.environ.get(name, "0") not in ("", "0") for name in RANKS):
        yield
        return
    with (run / ".lock").open("ab") as file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in HELD:
                keys = "hydra.run.dir, or paths.out of a sweep,"
                wanted = f"{keys} must be another folder"
                raise ValueError(f"{wanted}: another process writes into {run}") from None
        yield
