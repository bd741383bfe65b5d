"""Published checkpoints are pickles; this reader executes nothing of them."""

import collections
import pickle
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from src.models.checkpoints import larger_inside

ALLOWED = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
    ("torch._utils", "_rebuild_parameter"): torch._utils._rebuild_parameter,
    ("torch", "Size"): torch.Size,
}


class Inert:
    """Stands for an object of an unknown class: takes anything, does nothing."""

    def __init__(self, *args: Any, **kwargs: Any):
        pass

    def __setstate__(self, state: Any) -> None:
        pass

    def __setitem__(self, key: Any, value: Any) -> None:
        pass

    def append(self, value: Any) -> None:
        """Drop the value."""

    def extend(self, values: Any) -> None:
        """Drop the values."""


class Unpickler(pickle._Unpickler):
    """Builds tensors and containers; unknown classes are inert, the standard library refused.

    The one in Python: the compiled one takes the memory for as many objects as a pickle claims.
    """

    def find_class(self, module: str, name: str) -> Any:
        """Return what a name in the pickle stands for; ValueError for what could run code."""
        if (module, name) in ALLOWED:
            return ALLOWED[module, name]
        if module.split(".")[0] in sys.stdlib_module_names and module != "pathlib":
            raise ValueError(f"baseline.weights must hold tensors, got a call of {module}.{name}")
        return Inert


def _load(file: Any, **kwargs: Any) -> Any:
    return Unpickler(file, **kwargs).load()


READER = SimpleNamespace(Unpickler=Unpickler, load=_load, __name__="baselines.pickles")


def read(path: str | Path) -> Any:
    """Return the content of a torch checkpoint.

    Raises ValueError, beginning with `baseline.weights`, when there is no such file, when it is no
    checkpoint, or when it wants to run code.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"baseline.weights must be a file, got {path}")
    try:
        if zipfile.is_zipfile(path):
            if larger_inside(path):
                raise ValueError(f"baseline.weights must hold tensors unpacked, got {path}")
            with zipfile.ZipFile(path) as archive:
                if any(name.endswith("constants.pkl") for name in archive.namelist()):
                    raise ValueError(f"baseline.weights must hold tensors, got a program in {path}")
        return torch.load(path, "cpu", pickle_module=READER, weights_only=False)
    except Exception as error:  # libraries raise all kinds on a broken file
        if str(error).startswith("baseline.weights"):
            raise
        raise ValueError(f"baseline.weights must be a torch checkpoint, got {path}") from error
