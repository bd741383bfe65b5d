"""The pre-simulated turbulence cache on a disk, shared by all trainings whose clips are the same.

A clip is one file in float16, renamed into place when it is complete, with PyTorch's checksums.
While a process simulates it, its byte of a lock file is locked by the system.
"""

import ast
import fcntl
import functools
import hashlib
import json
import multiprocessing
import os
import shutil
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch

import src.sim
from src.models.checkpoints import is_intact, save_atomically
from src.records.atomic import write_text
from src.sim.pipeline import Pipeline
from src.sim.scenes.video_files import walk_files
from src.training.clip_cache import GIB, CachedClip, ClipCache, simulate_clip
from src.training.worker_process import prepare_worker_process

INPUTS_FILE = "inputs.json"
# Parts of src/sim that no cached clip depends on, but for UPSTREAM, which decodes its frames.
UNUSED, UPSTREAM = ("sensor", "voxel.py", "scenes/user_clip.py"), "sensor/response.py"
MEASURED = "recordings/files/turbulence_file.py"  # in src, draws turbulence=measured
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


class DiskClipCache(ClipCache):
    """A cache in a folder below `root` that is named by a hash of `inputs`, plain data that decides
    about its clips, and of the code of the simulation.

    Raises ValueError where the disk has less free than the missing clips take.
    """

    def __init__(self, source: Pipeline, root: str | Path, inputs: Mapping[str, Any], **size: Any):
        super().__init__(source, **size)
        self.inputs = json.loads(json.dumps({**inputs, "simulation": hash_simulation_code()}))
        text = json.dumps(self.inputs, sort_keys=True)
        self.folder = Path(root) / hashlib.sha256(text.encode()).hexdigest()[:12]
        self.verified: set[int] = set()
        self.folder.mkdir(parents=True, exist_ok=True)
        if not (self.folder / INPUTS_FILE).exists():
            write_text(self.folder / INPUTS_FILE, json.dumps(self.inputs, indent=1))
        needed = len(self.missing()) * self.clip_bytes
        free = shutil.disk_usage(self.folder).free
        if needed > free:
            raise ValueError(
                f"data.cache_root must have {needed / GIB:.2f} GiB free for "
                f"data.cache_clips={self.clips}, got {free / GIB:.2f} in {self.folder}"
            )

    def path(self, index: int) -> Path:
        """Return the file of clip `index`, which need not exist."""
        return self.folder / f"{index:06}.pt"

    def has(self, index: int) -> bool:
        return self.path(index).exists()

    def store(self, index: int, clip: CachedClip) -> None:
        metadata = json.dumps(clip.metadata)
        content = {"views": clip.views.cpu(), "clean": clip.clean.cpu(), "metadata": metadata}
        try:
            save_atomically(content, self.path(index))
        except (OSError, RuntimeError) as error:  # PyTorch's writer has an error of its own
            raise OSError(f"{self.folder}: clip {index} cannot be stored: {error}") from error

    def clip(self, index: int) -> CachedClip:
        """Return clip `index`, memory-mapped; one that is missing or damaged is simulated, or
        waited for while another process does.  A full disk is a warning.
        """
        if not self._is_valid(index):
            with self._lock_clip(index):
                if not self._is_valid(index):
                    clip = simulate_clip(self.source, index, "cpu")
                    try:
                        self.store(index, clip)
                    except OSError as error:
                        warnings.warn(str(error), stacklevel=2)
                    return clip._replace(metadata=json.loads(json.dumps(clip.metadata)))
        content = torch.load(self.path(index), mmap=True, weights_only=True)
        return CachedClip(content["views"], content["clean"], json.loads(content["metadata"]))

    def fill(self) -> None:
        """Simulate what is missing and no other process simulates, on the CPU.

        Raises OSError where a clip cannot be stored.
        """
        for index in self.missing():
            with self._lock_clip(index, wait=False) as is_mine:
                if is_mine and not self.has(index):
                    self.store(index, simulate_clip(self.source, index, "cpu"))

    @contextmanager
    def _lock_clip(self, index: int, wait: bool = True) -> Iterator[bool]:
        """Be the one process that simulates a clip; else wait for the other, or yield False."""
        with (self.folder / "clips.lock").open("ab") as file:
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, index)
            except (BlockingIOError, PermissionError):
                yield False
            else:
                yield True

    def status(self) -> str:
        """Return one line: folder, clips and size, and how many caches beside it are not used."""
        count, size = self.clips - len(self.missing()), self.clips * self.clip_bytes / GIB
        line = f"cache {self.folder}: {count} of {self.clips} clips, {size:.2f} GiB when full"
        others = len(list(self.folder.parent.glob(f"*/{INPUTS_FILE}"))) - 1
        return line + (f"; {others} of other configs, see their {INPUTS_FILE}" if others else "")

    def _is_valid(self, index: int) -> bool:
        """Return whether a clip exists and has its checksums, which are computed once."""
        if not self.has(index):
            return False
        if index not in self.verified:
            if not is_intact(self.path(index)):
                warnings.warn(f"{self.path(index)} is damaged and simulated again", stacklevel=3)
                return False
            self.verified.add(index)
        return True


class CacheFillerProcess:
    """A process of lowest priority that simulates the missing clips of caches, one after the other.

    Of all trainings that share a cache one fills it; when it ends, another takes over.  It ends
    when the caches are full, with `stop`, and with the process that started it.
    """

    def __init__(self, *caches: DiskClipCache):
        self.caches = caches
        self.process: BaseProcess | None = None

    def start(self) -> None:
        """Start the process, if a clip is missing."""
        if any(cache.missing() for cache in self.caches):
            spawn = multiprocessing.get_context("spawn")  # a fork would take locks of threads along
            self.process = spawn.Process(target=_fill_caches, args=(self.caches,), daemon=True)
            self.process.start()

    def stop(self) -> None:
        """End the process; the clip it was simulating stays missing."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None


def _fill_caches(caches: Sequence[DiskClipCache]) -> None:
    os.nice(19)
    prepare_worker_process()
    for cache in caches:
        with (cache.folder / "filler.lock").open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            try:
                cache.fill()
            except (OSError, ValueError) as error:  # the training meets it where it needs the clip
                print(f"filling stops: {error}", file=sys.stderr)


@functools.cache
def hash_simulation_code() -> str:
    """Return a hash of the code and tables that make clips, `list_simulation_files`."""
    digest, root = hashlib.sha256(), Path(src.sim.__file__).parent.parent
    for path in list_simulation_files():
        digest.update(path.relative_to(root).as_posix().encode() + read_without_comments(path))
    return digest.hexdigest()[:12]


def list_simulation_files() -> list[Path]:
    """Return the files of code and tables that a cached clip depends on."""
    home = Path(src.sim.__file__).parent
    files = [path for path in home.rglob("*") if path.suffix in (".py", ".safetensors")]
    parts = [home / part for part in UNUSED]
    used = [path for path in files if not any(map(path.is_relative_to, parts))]
    return sorted([*used, home / UPSTREAM, home.parent / MEASURED])


def read_without_comments(path: Path) -> bytes:
    """Return what a file says: of code, all but comments, docstrings and layout."""
    if path.suffix != ".py":
        return path.read_bytes()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree).encode()


def hash_file_lists(config: Any) -> str:
    """Return a hash of names and sizes of the files below every `root`, `extra_train_root` or
    `footage` in a plain config: a folder, a file (a pack of photographs) or a list of these.
    """
    digest = hashlib.sha256()
    for root in _roots(config):
        place = Path(root)
        files = sorted(walk_files(place)) if place.is_dir() else [place] * place.is_file()
        names = [f"{path.relative_to(root)}:{path.stat().st_size}" for path in files]
        digest.update(json.dumps(names).encode())
    return digest.hexdigest()[:12]


def _roots(node: Any, key: str = "") -> Iterator[str]:
    if isinstance(node, str) and key in ("root", "extra_train_root", "footage"):
        yield node
    items = [(key, value) for value in node] if isinstance(node, list) else []
    for name, value in node.items() if isinstance(node, dict) else items:
        yield from _roots(value, name)
