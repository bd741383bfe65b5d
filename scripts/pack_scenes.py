"""Photographs in one small file that `scene.root` takes, for a machine that gets little:

    python -m scripts.pack_scenes FOLDER [FOLDER ...] OUT.pack side=288 mib=40 [train_only=FOLDER]

Grey, the shorter side at most `side` pixels, WebP at the best quality with which the file is at
most `mib` MiB.  Each FOLDER keeps its split as `scene.root=[FOLDER,...]` has it; what is in the
folders `train_only` serves training only.  The format: src/sim/scenes/photo_files.py.
"""

import argparse
import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from src.app.script import run_script
from src.records.atomic import atomic_path
from src.sim.scenes.clip import SPLITS
from src.sim.scenes.photo_files import (
    CHECKSUM,
    INDEX,
    PackedPhotograph,
    find_root,
    list_photographs,
    list_train_only_photographs,
    open_photo_pack,
    read_luminance,
)

WORST, BEST = 10, 100  # quality of WebP; below 10 textures are gone
SIDES = (16, 4096)  # px
MIB = 2**20


class EncodedPicture(NamedTuple):
    """A picture to be packed: its `name`, the `split` it belongs to, `data`, encoded, and `shape`
    (height, width), pixels.
    """

    name: str
    split: str
    data: bytes
    shape: tuple[int, int]


class GreyPhotograph(NamedTuple):
    """A photograph to be packed: its name in the pack, its split and its pixels (h, w), uint8."""

    name: str
    split: str
    pixels: NDArray


def write_pack(
    folders: Sequence[str], out: Path, *, side: int, mib: float, train_only: Sequence[str] = ()
) -> str:
    """Write the photographs of `folders`, and those of `train_only`, to `out`; return a line.

    Raises ValueError, before anything is written, for what cannot be read and for a budget that
    cannot be kept.
    """
    if not SIDES[0] <= side <= SIDES[1]:
        raise ValueError(f"side must be in {SIDES[0]}..{SIDES[1]} (px), got {side}")
    sources = read_photographs(folders, train_only, side)
    quality, content = encode_within_mib(sources, mib)
    with atomic_path(out) as partial:
        partial.write_bytes(content)
    counts = [sum(source.split == split for source in sources) for split in SPLITS]
    parts = ", ".join(f"{n} {split}" for n, split in zip(counts, SPLITS, strict=True))
    size = f"{len(content) / MIB:.2f} MiB"
    return f"{out}: {verify_pack(out)} photographs ({parts}), WebP at quality {quality}, {size}"


def read_photographs(
    folders: Sequence[str], train_only: Sequence[str], side: int
) -> list[GreyPhotograph]:
    """Return the photographs in the order of the splits' lists, each at most `side` px high and
    wide; raises ValueError naming one that cannot be read, and for folders of the same name.
    """
    roots = [Path(one) for one in (*folders, *train_only)]
    names = [root.resolve().name for root in roots]
    if len(set(names)) < len(names):
        raise ValueError(f"FOLDER must differ in name from the others, got {', '.join(names)}")
    chosen = [(path, split) for split in SPLITS for path in list_photographs(folders, split)]
    if train_only:
        chosen += [(path, "train") for path in list_train_only_photographs(train_only, folders)]
    with ThreadPoolExecutor() as pool:
        pixels = pool.map(lambda one: _read_shrunk(one[0], side), chosen)
        pairs = zip(chosen, pixels, strict=True)
        return [GreyPhotograph(_name(path, roots), split, grey) for (path, split), grey in pairs]


def encode_within_mib(sources: Sequence[GreyPhotograph], mib: float) -> tuple[int, bytes]:
    """Return the best quality with which the pack is at most `mib` MiB, and the pack.

    Raises ValueError, with what the worst quality would need, where there is none.
    """
    low, high, best = WORST, BEST, None
    while low <= high:
        quality = (low + high) // 2
        content = build_pack(_encode(sources, quality))
        if len(content) <= mib * MIB:
            low, best = quality + 1, (quality, content)
        else:
            high, least = quality - 1, len(content)
    if best is None:
        needed = f"{least / MIB:.2f} for {len(sources)} photographs at quality {WORST}"
        raise ValueError(f"mib must be >= {needed} (a smaller side takes less), got {mib:g}")
    return best


def build_pack(pictures: Sequence[EncodedPicture]) -> bytes:
    """Return the file that holds `pictures`, whose names all differ."""
    index: dict[str, dict] = {}
    for name, split, data, shape in pictures:
        index.setdefault(split, {})[name] = [*shape, sha256(data).hexdigest()]
    text = json.dumps(index, separators=(",", ":")).encode()
    blobs = {picture.name: np.frombuffer(picture.data, np.uint8) for picture in pictures}
    blobs[INDEX] = np.frombuffer(text, np.uint8)
    return save(blobs, {CHECKSUM: sha256(text).hexdigest()})


def verify_pack(path: Path) -> int:
    """Return how many photographs a pack holds; raises ValueError naming the first damaged one."""
    names = [name for names in open_photo_pack(path)[1].values() for name in names]
    for name in names:
        PackedPhotograph(path, name).data()
    return len(names)


def _read_shrunk(path: Path, side: int) -> NDArray:
    picture = read_luminance(path)
    if picture is None or min(picture.shape) < 16:
        wanted = "readable photographs of 16 px or more, none cut short"
        raise ValueError(f"FOLDER must hold {wanted}, got {path}")
    scale = side / min(picture.shape)
    if scale >= 1:
        return picture
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _name(path: Path, roots: Sequence[Path]) -> str:
    """Return the name in the pack: the folder's own and what is below it."""
    root = find_root(path, roots)
    assert root is not None
    return (root.resolve().name / path.relative_to(root)).as_posix()


def _encode(sources: Sequence[GreyPhotograph], quality: int) -> list[EncodedPicture]:
    with ThreadPoolExecutor() as pool:
        blobs = pool.map(lambda source: _webp(source.pixels, quality), sources)
        pairs = zip(sources, blobs, strict=True)
        return [EncodedPicture(one.name, one.split, blob, one.pixels.shape) for one, blob in pairs]


def _webp(pixels: NDArray, quality: int) -> bytes:
    made, blob = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not made:
        raise ValueError(f"side must be smaller for WebP, got a picture of {pixels.shape}")
    return np.asarray(blob).tobytes()


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="+", help="folders, the pack and key=value, as above")
    words = parser.parse_args().words
    places = [word for word in words if "=" not in word]
    pairs = [word.split("=", 1) for word in words if "=" in word]
    given = {"side": "288", "mib": "40"} | {key: value for key, value in pairs}
    if len(places) < 2:
        parser.error("FOLDER and OUT.pack must be given")
    if others := sorted(set(given) - {"side", "mib", "train_only"}):
        parser.error(f"key must be side, mib or train_only, got {others[0]}")
    only = [value for key, value in pairs if key == "train_only"]
    side, mib = _number("side", given["side"], int), _number("mib", given["mib"], float)
    print(write_pack(places[:-1], Path(places[-1]), side=side, mib=mib, train_only=only))


def _number(key: str, text: str, kind: type) -> int | float:
    try:
        return kind(text)
    except ValueError:
        raise ValueError(f"{key} must be a number, got {text}") from None


if __name__ == "__main__":
    run_script(main)
