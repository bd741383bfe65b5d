"""Photographs in one file: what `python -m scripts.pack_scenes` writes and `scene.root` takes.

The file is safetensors: under each name an encoded picture (WebP or any other that OpenCV decodes)
as uint8, under `index.json` the index, {split: {name: [height, width, SHA-256 of the picture]}} in
the order of the splits' lists, and in the file's metadata `index_sha256`.  It is mapped, not read:
a picture costs its own bytes, processes share the rest.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

INDEX, CHECKSUM = "index.json", "index_sha256"


class Picture(NamedTuple):
    """A picture to be packed: its `name`, the `split` it belongs to, `data`, encoded, and `shape`
    (height, width), pixels.
    """

    name: str
    split: str
    data: bytes
    shape: tuple[int, int]


@dataclass(frozen=True)
class Packed:
    """The photograph `name` of the file `pack`."""

    pack: Path
    name: str

    def __str__(self) -> str:
        return f"{self.pack}: {self.name}"

    @property
    def stem(self) -> str:
        """The name without folders and suffix, as of a path."""
        return PurePosixPath(self.name).stem

    def data(self) -> bytes:
        """Return the encoded picture; raises ValueError where its checksum is not the index's."""
        file, index = _opened(self.pack)
        _, _, checksum = next(names[self.name] for names in index.values() if self.name in names)
        try:
            data = file.get_tensor(self.name).tobytes()
        except SafetensorError as error:
            raise _damaged(self.pack, self.name) from error
        if _sha256(data) != checksum:
            raise _damaged(self.pack, self.name)
        return data


def packed(pictures: Sequence[Picture]) -> bytes:
    """Return the file that holds `pictures`, whose names all differ."""
    index: dict[str, dict] = {}
    for name, split, data, shape in pictures:
        index.setdefault(split, {})[name] = [*shape, _sha256(data)]
    text = json.dumps(index, separators=(",", ":")).encode()
    blobs = {picture.name: np.frombuffer(picture.data, np.uint8) for picture in pictures}
    blobs[INDEX] = np.frombuffer(text, np.uint8)
    return save(blobs, {CHECKSUM: _sha256(text)})


def listed(path: Path, split: str) -> list[Packed]:
    """Return the photographs of a split, in the order they were packed in.

    Raises ValueError for a file that is no pack or whose index is damaged.
    """
    return [Packed(path, name) for name in _opened(path)[1].get(split, ())]


def check(path: Path) -> int:
    """Return how many photographs a pack holds; raises ValueError naming the first damaged one."""
    names = [name for names in _opened(path)[1].values() for name in names]
    for name in names:
        Packed(path, name).data()
    return len(names)


@lru_cache(maxsize=8)
def _opened(path: Path) -> tuple[Any, dict[str, dict[str, list]]]:
    """Return the mapped file and its index."""
    try:
        file = safe_open(path, "numpy")
        checksum = (file.metadata() or {})[CHECKSUM]
        text = file.get_tensor(INDEX).tobytes()
    except (SafetensorError, KeyError) as error:
        reason = f"scene.root must be a folder or a pack of photographs, whole, got {path}"
        raise ValueError(reason) from error
    if _sha256(text) != checksum:
        raise _damaged(path, INDEX)
    return file, json.loads(text)


def _damaged(path: Path, name: str) -> ValueError:
    return ValueError(f"scene.root: {path} is damaged: the SHA-256 of {name} is not as packed")


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
