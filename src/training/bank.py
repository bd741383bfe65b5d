"""The bank of air: what every view sees of a fixed set of clips, kept on disk for all trainings.

What turbulence does to a clip is slow and stays the same; sensor, crop and augmentation are cheap
and are drawn anew for every sample (bank_samples.py).  Clip i is a function of what made the bank
and of i, so it does not matter who makes it: a filler beforehand or in the background
(bank_filler.py), or the training that finds it missing or damaged.  A clip is one file in float16,
written whole, with PyTorch's checksum of each part; while it is made, its byte of a lock file is
locked, and the system unlocks it when the process ends, however it ends.
"""

import fcntl
import hashlib
import json
import shutil
import warnings
from ast import dump, parse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

import src.sim
from src.models.checkpoints import WholeFiles, whole
from src.records.atomic import write_text
from src.sim.pipeline import Pipeline
from src.training.device_cache import GIB, simulated

FACTS = 4096  # bytes of a file beside its pictures, at most
MADE_OF = "made_of.json"
NOTE = 1 << 40  # the byte of the lock file that is locked while MADE_OF is written
LATER = ("sensor", "voxel.py")  # the parts of src/sim that come after the bank


class Bank:
    """`clips` clips of what `source` shows, each of `frames` frames of `source.crop` pixels square.

    `root`: the folder of all banks; this one is in a folder named by the hash of `made_of`, plain
    data that says all that makes a clip, and of the simulation's code.  `gib`: the disk it may take
    when full.  Raises ValueError, naming the key, where it would take more, or more than is free.
    """

    def __init__(
        self,
        source: Pipeline,
        root: str | Path,
        made_of: Mapping[str, Any],
        *,
        clips: int,
        frames: int,
        gib: float,
    ):
        self.source, self.clips, self.frames = source, clips, frames
        self.bytes = 2 * (source.optics.views + 1) * frames * source.crop**2 + FACTS
        full = clips * self.bytes / GIB
        if not full <= gib:
            raise ValueError(
                f"data.bank_gib must be >= {full:.2f} for data.bank={clips}, "
                f"{self.bytes / 2**20:.1f} MiB a clip, got {gib}"
            )
        self.made_of = json.loads(json.dumps({**made_of, "simulation": simulation()}))
        text = json.dumps(self.made_of, sort_keys=True)
        self.folder = Path(root) / hashlib.sha256(text.encode()).hexdigest()[:12]
        self.checked: set[int] = set()
        self._open()

    def path(self, index: int) -> Path:
        """Return the file of clip `index`."""
        return self.folder / f"{index:06}.pt"

    def missing(self) -> list[int]:
        """Return the clips that are not there yet."""
        return [index for index in range(self.clips) if not self.path(index).exists()]

    def clip(self, index: int) -> dict:
        """Return clip `index`, memory-mapped: `views` (views, frames, h, w), what the optics put on
        the sensor, light; `clean` (frames, h, w), code values; both float16; `facts`, JSON.

        A clip that is missing or damaged is made, or waited for where somebody is making it.
        """
        if not self._sound(index):
            with self.claim(index):
                if not self._sound(index):
                    return self.make(index)
        return torch.load(self.path(index), mmap=True, weights_only=True)

    def make(self, index: int, device: torch.device | str = "cpu") -> dict:
        """Simulate clip `index` on `device` and store it; a disk that is full is a warning."""
        views, clean, facts = simulated(self.source, index, device)
        clip = {"views": views.cpu().contiguous(), "clean": clean, "facts": json.dumps(facts)}
        try:
            WholeFiles().save_checkpoint(clip, self.path(index))
        except (OSError, RuntimeError) as error:  # PyTorch's writer has an error of its own
            warnings.warn(f"{self.folder}: clip {index} is not kept: {error}", stacklevel=2)
        return clip

    @contextmanager
    def claim(self, index: int, wait: bool = True) -> Iterator[bool]:
        """Be the one process that makes clip `index`.

        Where another is, wait for it, or yield False.
        """
        with (self.folder / "clips.lock").open("ab") as file:
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, index)
            except (BlockingIOError, PermissionError):
                yield False
            else:
                yield True

    def _sound(self, index: int) -> bool:
        """Return whether the clip is there, and with the checksums it was written with (these are
        computed once)."""
        if not self.path(index).exists():
            return False
        if index not in self.checked:
            if not whole(self.path(index)):
                warnings.warn(f"{self.path(index)} is damaged and made again", stacklevel=3)
                return False
            self.checked.add(index)
        return True

    def _open(self) -> None:
        """Make the folder; raise ValueError where it cannot hold this bank."""
        self.folder.mkdir(parents=True, exist_ok=True)
        note = self.folder / MADE_OF
        with self.claim(NOTE):
            if not note.exists():
                write_text(note, json.dumps(self.made_of, indent=1))
        if difference(note, self.made_of):
            raise ValueError(
                f"data.bank_root: {self.folder} was made by another config "
                f"({', '.join(difference(note, self.made_of))}); remove it"
            )
        rest = len(self.missing()) * self.bytes
        free = shutil.disk_usage(self.folder).free
        if rest > free:
            raise ValueError(
                f"data.bank_root must have {rest / GIB:.2f} GiB free for data.bank={self.clips}, "
                f"got {free / GIB:.2f} in {self.folder}"
            )

    def status(self) -> str:
        """Return one line: where, how full, and which banks beside it are of other configs."""
        there, size = self.clips - len(self.missing()), self.clips * self.bytes / GIB
        line = f"bank {self.folder}: {there} of {self.clips} clips, {size:.2f} GiB when full"
        others = [
            f"{note.parent.name} ({', '.join(difference(note, self.made_of))})"
            for note in sorted(self.folder.parent.glob(f"*/{MADE_OF}"))
            if note.parent != self.folder
        ]
        return line + (f"; not used, of other configs: {'; '.join(others)}" if others else "")


def difference(note: Path, made_of: Mapping[str, Any]) -> list[str]:
    """Return the keys in which the bank that `note` belongs to was made of something else."""
    try:
        other = json.loads(note.read_text())
    except (OSError, ValueError):
        other = None
    if not isinstance(other, dict):
        return [f"{note.name} cannot be read"]
    ours, theirs = _flat(made_of), _flat(other)
    keys = sorted(ours.keys() | theirs.keys())
    return [key for key in keys if ours.get(key) != theirs.get(key)]


def simulation() -> str:
    """Return a hash of the code and tables that make clips: comments and layout do not count."""
    home, digest = Path(src.sim.__file__).parent, hashlib.sha256()
    for path in sorted(home.rglob("*")):
        place = path.relative_to(home)
        if place.parts[0] in LATER or path.suffix not in (".py", ".safetensors"):
            continue
        data = dump(parse(path.read_text())).encode() if path.suffix == ".py" else path.read_bytes()
        digest.update(str(place).encode() + data)
    return digest.hexdigest()[:12]


def listing(node: Any) -> str:
    """Return a hash of the files below every root in a config, by name and size."""
    digest = hashlib.sha256()
    for root in _roots(node):
        paths = [Path(root), *Path(root).rglob("*")]  # a pack of photographs is a file itself
        files = sorted(path for path in paths if path.is_file())
        names = [f"{path.relative_to(root)}:{path.stat().st_size}" for path in files]
        digest.update(json.dumps(names).encode())
    return digest.hexdigest()[:12]


def _roots(node: Any) -> Iterator[str]:
    """Yield the values of every key `root` or `train_root` in plain dicts and lists, but None."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key in ("root", "train_root"):
                yield from [value] if isinstance(value, str) else value or []
            else:
                yield from _roots(value)
    elif isinstance(node, list):
        for value in node:
            yield from _roots(value)


def _flat(node: Any, above: str = "") -> dict[str, Any]:
    if not isinstance(node, dict):
        return {above: node}
    parts = [_flat(value, f"{above}.{key}".strip(".")) for key, value in node.items()]
    return {key: value for part in parts for key, value in part.items()}
