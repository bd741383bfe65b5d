"""What a time-limited training leaves: few files, none too large, usable whenever it is cut.

`<name>.g<generation>.part<k>of<n>.safetensors` are float16 weights, each a whole file with network
and card in its header.  Files are written in a folder beside and renamed.  Where `budget` and
`files` leave room for two generations, the old one stays until the new one is complete; else a kill
in the milliseconds between two renames loses the network, which `join_exports` reports.
"""

import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from src.models import files
from src.records.atomic import atomic_path

TABLES = ("curves.csv", "profile.json")
TABLES_BYTES = 2**18  # of these together
HEADER_BYTES = 2**16  # of each file of weights, at most
PART = re.compile(r"([\w-]+)\.g(\d+)\.part(\d+)of(\d+)\.safetensors")


def split_into_parts(sizes: Mapping[str, int], limit: int) -> list[list[str]]:
    """Return the names in lists of at most `limit` bytes together: the largest first, each in the
    first list that has room.
    """
    parts: list[list[str]] = []
    for name in sorted(sizes, key=sizes.__getitem__, reverse=True):
        fits = (part for part in parts if sum(map(sizes.__getitem__, part)) + sizes[name] <= limit)
        if (part := next(fits, None)) is None:
            parts.append(part := [])
        part.append(name)
    return parts


class Exports:
    """The folder `out` that a lease exports to, empty at the beginning: at most `max_files` files
    of `file_bytes` each, `total_bytes` together.

    Raises ValueError where `out` holds files or cannot be made.
    """

    def __init__(self, out: Path, file_bytes: int, total_bytes: int, max_files: int):
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"out must be a folder to write to, got {out}: {error}") from error
        if found := sorted(out.iterdir()):
            raise ValueError(f"out must be empty, got {len(found)} files in {out}")
        self.out, self.file_bytes = out, file_bytes
        self.total_bytes, self.max_files = total_bytes, max_files
        self.generations: dict[str, int] = {}
        self.partial_folder = _same_disk(out) / f".{out.name}.partial"
        shutil.rmtree(self.partial_folder, ignore_errors=True)  # of a run that was killed
        self.partial_folder.mkdir()

    def export_weights(self, name: str, path: Path, facts: Mapping[str, Any]) -> int:
        """Export a file of `files.save`, `facts` added to its card; return the generation."""
        with safe_open(path, "pt") as file:
            header = dict(file.metadata())
        header["card"] = json.dumps(json.loads(header["card"]) | dict(facts))
        tensors = load_file(path)
        sizes = {key: value.nbytes for key, value in tensors.items()}
        parts = split_into_parts(sizes, self.file_bytes - HEADER_BYTES)
        self.generations[name] = generation = self.generations.get(name, 0) + 1
        new = []
        for k, keys in enumerate(parts, 1):
            file_name = f"{name}.g{generation}.part{k}of{len(parts)}.safetensors"
            new.append(self.partial_folder / file_name)
            save_file({key: tensors[key] for key in keys}, new[-1], header)
            _flush_to_disk(new[-1])
        self._replace_generation(name, new)
        return generation

    def _replace_generation(self, name: str, new: Sequence[Path]) -> None:
        parts = {path: PART.fullmatch(path.name) for path in sorted(self.out.iterdir())}
        old = [path for path, match in parts.items() if match and match[1] == name]
        both = [*(path for path, match in parts.items() if match), *new]
        size = TABLES_BYTES + sum(path.stat().st_size for path in both)
        if size <= self.total_bytes and len(both) + len(TABLES) <= self.max_files:
            for path in new:
                os.replace(path, self.out / path.name)
            for path in old:
                path.unlink()
        else:
            for before, path in zip(old, new, strict=True):
                before.unlink()
                os.replace(path, self.out / path.name)

    def export_text(self, name: str, text: str) -> None:
        """Export one of TABLES."""
        (self.partial_folder / name).write_text(text)
        _flush_to_disk(self.partial_folder / name)
        os.replace(self.partial_folder / name, self.out / name)

    def close(self) -> None:
        """Remove the folder that files are written in."""
        shutil.rmtree(self.partial_folder, ignore_errors=True)


def join_exports(folder: Path, to: Path) -> tuple[list[Path], list[str]]:
    """Write what leases exported to `folder` and below as one file of weights for each network into
    `to`; return these files and, in a line each, what is lost.

    Raises ValueError where nothing was exported.
    """
    found: dict[str, dict[int, dict[int, Path]]] = {}
    counts: dict[tuple[str, int], int] = {}
    for path in sorted(folder.rglob("*.safetensors")):
        if match := PART.fullmatch(path.name):
            name, generation, part, count = match[1], int(match[2]), int(match[3]), int(match[4])
            found.setdefault(name, {}).setdefault(generation, {})[part] = path
            counts[name, generation] = count
    if not found:
        raise ValueError(f"join must be given a folder that a lease has exported to, got {folder}")
    made, lost = [], []
    for name, generations in found.items():
        complete = [g for g, parts in generations.items() if len(parts) == counts[name, g]]
        if not complete:
            there = "; ".join(
                f"generation {g} has parts {', '.join(map(str, parts))} of {counts[name, g]}"
                for g, parts in sorted(generations.items())
            )
            lost.append(f"{name}: weights of no generation are whole: {there}")
            continue
        try:
            parts = generations[max(complete)]
            made.append(_join_parts(to, name, [parts[k] for k in sorted(parts)]))
        except (SafetensorError, ValueError) as error:
            lost.append(f"{name} is damaged: {error}")
    return made, lost


def _join_parts(to: Path, name: str, paths: Sequence[Path]) -> Path:
    target = to / f"{name}.safetensors"
    tensors = {key: value for path in paths for key, value in load_file(path).items()}
    with safe_open(paths[0], "pt") as file:
        header = {key: file.metadata()[key] for key in ("network", "card")}
    with atomic_path(target) as partial:
        save_file(tensors, partial, header)
    files.load(target)  # every tensor is there
    return target


def _flush_to_disk(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _same_disk(out: Path) -> Path:
    """Return a folder that files can be renamed from into `out`: beside it, or it is its own."""
    above = out.resolve().parent
    is_same = above.stat().st_dev == out.stat().st_dev and os.access(above, os.W_OK)
    return above if is_same else out
