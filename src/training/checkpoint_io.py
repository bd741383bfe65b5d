"""Lightning's checkpoints, written whole or not at all.

Lightning's own writer moves them from the system's temporary folder, which may be another disk.
"""

from pathlib import Path
from typing import Any

from lightning.pytorch.plugins.io import TorchCheckpointIO

from src.models.checkpoints import save_atomically


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's plugin that stores checkpoints; they are on the disk when it returns."""

    def save_checkpoint(self, checkpoint: dict, path: Any, storage_options: Any = None) -> None:
        """Write `checkpoint` to `path`; an OSError leaves what was there before."""
        save_atomically(checkpoint, Path(path))
