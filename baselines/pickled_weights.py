"""Weights of published checkpoints, which are pickles; nothing of them is executed."""

import pickletools
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.serialization import get_unsafe_globals_in_checkpoint, safe_globals

from src.models.checkpoints import is_compressed_zip
from src.models.files import check_weights_stored_whole

PICKLES = 5  # at the beginning of a checkpoint of PyTorch before 1.6, the weights' storages behind


class UnpickledPlaceholder:
    """Stands for an object of an unknown class: takes anything, does nothing."""

    def __init__(self, *args: Any, **kwargs: Any):
        pass

    def __setstate__(self, state: Any) -> None:
        pass


def read_pickled_tensors(path: Path) -> dict[str, Tensor]:
    """Return the state dict of a torch checkpoint.

    Raises ValueError, beginning with `baseline.weights`, when there is no such file, when it is no
    checkpoint, or when it holds no tensors.
    """
    if not path.is_file():
        raise ValueError(f"baseline.weights must be a file, got {path}")
    try:
        if zipfile.is_zipfile(path) and is_compressed_zip(path):
            raise ValueError("packed, it could fill the memory")
        with safe_globals([(UnpickledPlaceholder, name) for name in _unknown_globals(path)]):
            content = torch.load(path, "cpu", weights_only=True)
    except Exception as error:  # libraries raise all kinds on a broken file
        allowed = "an unpacked torch checkpoint"
        raise ValueError(f"baseline.weights must be {allowed}, got {path}") from error
    content = content.get("state_dict", content) if isinstance(content, dict) else {}
    items = content.items() if isinstance(content, dict) else ()
    weights = {name: value for name, value in items if isinstance(value, Tensor)}
    if not weights:
        raise ValueError(f"baseline.weights must hold a state dict, got no tensors in {path}")
    check_weights_stored_whole(weights, path, "baseline.weights")
    return weights


def _unknown_globals(path: Path) -> list[str]:
    if zipfile.is_zipfile(path):
        return get_unsafe_globals_in_checkpoint(path)
    with path.open("rb") as file:
        opcodes = [code for _ in range(PICKLES) for code in pickletools.genops(file)]
    return [str(name).replace(" ", ".") for code, name, _ in opcodes if code.name == "GLOBAL"]
