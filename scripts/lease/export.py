"""What a time-limited training leaves: few files, none too large, usable whenever it is cut.

`<name>.<slot>.part<k>of<n>.safetensors` are float16 weights, each a whole file with network, card
and generation in its header, `<name>.<slot>.ckpt<k>of<n>.safetensors` the bytes of a checkpoint,
which goes on to the same bits.  Files are written in a folder beside and renamed.  The generation
in the header counts, so parts of two never mix: where there is room for two, they take turns in two
slots and the old one stays until the new one is whole; else a kill in the millisecond between two
renames loses the network, which `join` says.
"""

import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from src.models import files
from src.models.checkpoints import whole
from src.records.atomic import written

TABLES = ("curves.csv", "profile.json")
TABLES_BYTES = 2**18  # of these together
KEPT_FREE = 2**16  # of each file of weights, for its header
PART = re.compile(r"([\w-]+)\.[01]\.(part|ckpt)\d+of\d+\.safetensors")


def parts_of(sizes: Mapping[str, int], limit: int) -> list[list[str]]:
    """Return the names in their order, in lists of at most `limit` bytes together."""
    parts, size = [[]], 0
    for name, own in sizes.items():
        if parts[-1] and size + own > limit:
            parts, size = [*parts, []], 0
        parts[-1].append(name)
        size += own
    return parts


class Exports:
    """The folder `out` that a lease exports to, empty at the beginning.

    `file_bytes`: of a file, at most; `doubled`: networks of which the last whole generation stays
    until the next one is.  Raises ValueError where `out` holds files or cannot be made.
    """

    def __init__(self, out: Path, file_bytes: int, doubled: Iterable[str]):
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"out must be a folder to write to, got {out}: {error}") from error
        if there := sorted(out.iterdir()):
            raise ValueError(f"out must be empty, got {len(there)} files in {out}")
        self.out, self.file_bytes, self.doubled = out, file_bytes, set(doubled)
        self.generations: dict[tuple[str, str], int] = {}
        self.beside = _one_disk(out) / f".{out.name}.partial"
        shutil.rmtree(self.beside, ignore_errors=True)  # of a run that was killed
        self.beside.mkdir()

    def weights(self, name: str, path: Path, facts: Mapping[str, Any]) -> int:
        """Export a file of `files.save`, `facts` added to its card; returns the generation."""
        with safe_open(path, "pt") as file:
            header = dict(file.metadata())
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        header["card"] = json.dumps(json.loads(header["card"]) | dict(facts))
        sizes = {key: value.nbytes for key, value in tensors.items()}
        parts = parts_of(sizes, self.file_bytes - KEPT_FREE)
        contents = [{key: tensors[key] for key in keys} for keys in parts]
        return self._publish(name, "part", contents, header)

    def checkpoint(self, name: str, path: Path) -> None:
        """Export a checkpoint, which is removed."""
        data = torch.frombuffer(bytearray(path.read_bytes()), dtype=torch.uint8)
        path.unlink()
        pieces = data.split(self.file_bytes - KEPT_FREE)
        self._publish(name, "ckpt", [{"bytes": piece} for piece in pieces], {})

    def text(self, name: str, text: str) -> None:
        """Export one of TABLES."""
        (self.beside / name).write_text(text)
        _on_disk(self.beside / name)
        os.replace(self.beside / name, self.out / name)

    def close(self) -> None:
        """Remove the folder that files are written in."""
        shutil.rmtree(self.beside, ignore_errors=True)

    def _publish(
        self, name: str, kind: str, contents: Sequence[Mapping[str, Tensor]], header: dict
    ) -> int:
        """Put a new generation in the place of the one before; return its number."""
        number = self.generations.get((name, kind), 0) + 1
        slot = number % 2 if kind == "part" and name in self.doubled else 0
        count, made = len(contents), []
        for k, tensors in enumerate(contents, 1):
            made.append(self.beside / f"{name}.{slot}.{kind}{k}of{count}.safetensors")
            place = {"generation": str(number), "part": str(k), "parts": str(count)}
            save_file(dict(tensors), made[-1], header | place)
            _on_disk(made[-1])
        new = [self.out / path.name for path in made]
        for path, target in zip(made, new, strict=True):
            os.replace(path, target)
        for path in self.out.iterdir():
            found = PART.fullmatch(path.name)
            if found and found.groups() == (name, kind) and path not in new:
                path.unlink()
        self.generations[name, kind] = number
        return number


class Part(NamedTuple):
    """A file of a generation: which of how many."""

    part: int
    parts: int
    path: Path


def join(folder: Path, to: Path) -> tuple[list[Path], list[str]]:
    """Write what a lease has exported to `folder` as one file of weights for each network, and one
    checkpoint where there is one, into `to`; returns these files and, in a line each, what is lost.

    Raises ValueError where nothing was exported.
    """
    found: dict[tuple[str, str], dict[int, list[Part]]] = {}
    made, lost = [], []
    for path in sorted(folder.rglob("*.safetensors")):
        if match := PART.fullmatch(path.name):
            generations = found.setdefault(match.groups(), {})
            try:
                with safe_open(path, "pt") as file:
                    facts = file.metadata()
                part = Part(int(facts["part"]), int(facts["parts"]), path)
                generations.setdefault(int(facts["generation"]), []).append(part)
            except (SafetensorError, KeyError, TypeError, ValueError) as error:
                lost.append(f"{path.name} is damaged: {error}")
    if not found:
        raise ValueError(f"join must be given a folder that a lease has exported to, got {folder}")
    for (name, kind), generations in found.items():
        try:
            made.append(_joined(to, name, kind, generations))
        except ValueError as error:
            lost.append(f"{name}: {error}")
    return made, lost


def _joined(to: Path, name: str, kind: str, generations: Mapping[int, list[Part]]) -> Path:
    """Write the newest whole generation as one file; ValueError where none is whole."""
    for _, parts in sorted(generations.items(), reverse=True):
        parts = sorted(parts)
        if [one.part for one in parts] == list(range(1, parts[0].parts + 1)):
            paths = [one.path for one in parts]
            return (_join_weights if kind == "part" else _join_checkpoint)(to, name, paths)
    had = "; ".join(
        f"generation {number} has parts {', '.join(str(one.part) for one in sorted(parts))} of "
        f"{parts[0].parts}"
        for number, parts in sorted(generations.items())
    )
    what = "weights" if kind == "part" else "the checkpoint"
    raise ValueError(f"{what} of no generation are whole: {had}")


def _join_weights(to: Path, name: str, paths: Sequence[Path]) -> Path:
    target = to / f"{name}.safetensors"
    tensors = {key: value for path in paths for key, value in load_file(path).items()}
    with safe_open(paths[0], "pt") as file:
        header = {key: file.metadata()[key] for key in ("network", "card")}
    with written(target) as partial:
        save_file(tensors, partial, header)
    files.load(target)  # every tensor is there
    return target


def _join_checkpoint(to: Path, name: str, paths: Sequence[Path]) -> Path:
    with written(to / f"{name}.ckpt") as partial:
        with partial.open("wb") as file:
            for path in paths:
                file.write(load_file(path)["bytes"].numpy().tobytes())
        if not whole(partial):
            raise ValueError("the checkpoint is damaged")
    return to / f"{name}.ckpt"


def _on_disk(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _one_disk(out: Path) -> Path:
    """Return a folder that files can be renamed from into `out`: beside it, or it is its own."""
    above = out.resolve().parent
    same = above.stat().st_dev == out.stat().st_dev and os.access(above, os.W_OK)
    return above if same else out
