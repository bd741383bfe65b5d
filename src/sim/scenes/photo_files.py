"""Which photographs there are, which split each belongs to, and how one is read.

Many may lie in one file, a pack, which `python -m scripts.pack_scenes` writes: safetensors, under
each name an encoded picture (WebP or any other that OpenCV decodes) as uint8, under `index.json`
the index, {split: {name: [height, width, SHA-256 of the picture]}} in the order of the splits'
lists, and in the file's metadata `index_sha256`.  It is mapped, not read.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from safetensors import SafetensorError, safe_open

from src.sim.scenes.clip import check_split
from src.sim.scenes.video_files import PICTURE_SUFFIXES, read_picture

SHARES = {"train": (0, 1, 2, 3, 5, 6, 8), "val": (4,), "test": (7, 9)}  # of ten photographs
LARGEST_SIDE = 1024  # of a photograph in memory
INDEX, CHECKSUM = "index.json", "index_sha256"  # of a pack

# The photographs inside the scikit-image wheel; no split shares one with another, each has scenes
# and textures.
EMBEDDED = {
    "train": "astronaut brick camera coffee grass hubble_deep_field moon motorcycle_left retina",
    "val": "coins",
    "test": "chelsea gravel rocket",
}


@dataclass(frozen=True)
class PackedPhotograph:
    """The photograph `name` of the file `pack`."""

    pack: Path
    name: str

    def __str__(self) -> str:
        return f"{self.pack}: {self.name}"

    @property
    def stem(self) -> str:
        return PurePosixPath(self.name).stem

    def data(self) -> bytes:
        """Return the encoded picture; raises ValueError where its checksum is not the index's."""
        file, index = open_photo_pack(self.pack)
        _, _, checksum = next(names[self.name] for names in index.values() if self.name in names)
        return _read_checked(file, self.pack, self.name, checksum)


Photograph = Path | PackedPhotograph
Root = str | Sequence[str] | None


def list_photographs(root: Root, split: str) -> list[Photograph]:
    """Return the photographs of a split: of several folders or packs, each one's own share of it.

    `root` None: those inside scikit-image.  Raises ValueError where there are none, for a split
    that is none, and for a folder within another, whose photographs would be in two splits.
    """
    check_split(split)
    if root is None:
        spec = find_spec("skimage")
        assert spec is not None and spec.origin is not None
        folder = Path(spec.origin).parent / "data"
        embedded = {path.stem: path for path in folder.iterdir() if path.suffix in PICTURE_SUFFIXES}
        return [embedded[name] for name in EMBEDDED[split].split()]
    roots = list_roots("root", root)
    places = [one.resolve() for one in roots]
    for k, place in enumerate(places):
        if any(place.is_relative_to(other) for other in (*places[:k], *places[k + 1 :])):
            raise ValueError(f"scene.root must be folders apart, got {roots[k]} within another")
    return [photo for one in roots for photo in _share(one, split)]


def list_train_only_photographs(extra_train_root: Root, scene_root: Root) -> list[Photograph]:
    """Return the photographs that serve training only: all of a folder, of a pack its share.

    Raises ValueError where there are none, and where one of the two is within the other, as what
    `scene_root` keeps for validation and test would be trained on.
    """
    places = [one.resolve() for one in list_roots("root", scene_root)]
    found: list[Photograph] = []
    for one in list_roots("extra_train_root", extra_train_root):
        here = one.resolve()
        if any(here.is_relative_to(place) or place.is_relative_to(here) for place in places):
            raise ValueError(f"scene.extra_train_root must be apart from scene.root, got {one}")
        photos = _packed(one, "train") if one.is_file() else _pictures(one)
        if not photos:
            raise ValueError(f"scene.extra_train_root must hold photographs, got none in {one}")
        found += photos
    return found


def list_roots(key: str, root: Root) -> list[Path]:
    """Return the folders and packs that `scene.<key>` names, none for None.

    Raises ValueError for an empty list and for one that does not exist.
    """
    if root is None:
        return []
    roots = [Path(one) for one in ([root] if isinstance(root, str) else root)]
    if not roots:
        raise ValueError(f"scene.{key} must be a folder or a pack, or some, got an empty list")
    for one in roots:
        if not one.exists():
            raise ValueError(f"scene.{key} must be a folder or a pack of photographs, got {one}")
    return roots


def name_roots(roots: Sequence[Path]) -> dict[Path, str]:
    """Return for each folder or pack its name, after as many folders above it as tell it from the
    others; "" for the only one."""
    places = [root.resolve().parts for root in roots]
    if len(set(places)) < 2:
        return dict.fromkeys(roots, "")
    depth = 1
    while len({parts[-depth:] for parts in places}) < len(set(places)):
        depth += 1
    return {root: "/".join(parts[-depth:]) for root, parts in zip(roots, places, strict=True)}


def name_source(photo: Photograph, root_names: Mapping[Path, str]) -> str:
    """Return where a photograph lies below its root, after its root's name, without suffix:
    `coast/001`; the stem of one of scikit-image's.  Pictures of one stem in one folder are taken
    for one photograph.
    """
    root = find_root(photo, list(root_names))
    if root is None:
        return photo.stem
    inner = photo.name if isinstance(photo, PackedPhotograph) else photo.relative_to(root)
    return PurePosixPath(root_names[root], inner).with_suffix("").as_posix()


def find_root(photo: Photograph, roots: Sequence[Path]) -> Path | None:
    """Return which of `roots` a photograph was found in, None where in none of them."""
    place = photo.pack if isinstance(photo, PackedPhotograph) else photo
    found = [root for root in roots if place.is_relative_to(root)]
    return max(found, key=lambda root: len(root.parts), default=None)  # a/../b is not within a


@lru_cache(maxsize=8)
def open_photo_pack(path: Path) -> tuple[Any, dict[str, dict[str, list]]]:
    """Return the mapped file and its index.

    Raises ValueError for a file that is no pack or whose index is damaged.
    """
    try:
        file = safe_open(path, "numpy")
        checksum = (file.metadata() or {})[CHECKSUM]
        file.get_tensor(INDEX)
    except (SafetensorError, KeyError) as error:
        reason = f"scene.root must be a folder or a pack of photographs, whole, got {path}"
        raise ValueError(reason) from error
    return file, json.loads(_read_checked(file, path, INDEX, checksum))


@lru_cache(maxsize=512)
def decode_photograph(photo: Photograph) -> UInt8[np.ndarray, "h w"]:
    """Return a photograph's luminance as uint8, at most LARGEST_SIDE long.

    Raises ValueError for one that cannot be read or is cut short, for one of a pack that is not as
    packed, and for a side below 16 px.
    """
    picture = read_picture(photo.data() if isinstance(photo, PackedPhotograph) else photo)
    shrink = 1 if picture is None else min(1, LARGEST_SIDE / max(picture.shape))
    if picture is None or shrink * min(picture.shape) < 16:
        wanted = "readable photographs, whole and of 16 px or more"
        raise ValueError(f"scene.root must hold {wanted}, got {photo}")
    if shrink < 1:
        picture = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return picture


def _share(root: Path, split: str) -> list[Photograph]:
    if root.is_file():
        photos = _packed(root, split)
        if not photos:
            raise ValueError(f"scene.root must hold photographs of split={split}, got {root}")
        return photos
    paths = _pictures(root)
    if len(paths) < 10:
        found = f"{len(paths)} in {root}"
        raise ValueError(f"scene.root must hold at least 10 photographs, got {found}")
    return [path for place, path in enumerate(paths) if place % 10 in SHARES[split]]


def _packed(pack: Path, split: str) -> list[Photograph]:
    return [PackedPhotograph(pack, name) for name in open_photo_pack(pack)[1].get(split, ())]


def _pictures(folder: Path) -> list[Photograph]:
    return [*sorted(p for p in folder.rglob("*") if p.suffix.lower() in PICTURE_SUFFIXES)]


def _read_checked(file: Any, path: Path, name: str, checksum: str) -> bytes:
    try:
        data = file.get_tensor(name).tobytes()
    except SafetensorError:
        data = b""
    if sha256(data).hexdigest() != checksum:
        reason = f"is damaged: the SHA-256 of {name} is not as packed"
        raise ValueError(f"scene.root: {path} {reason}")
    return data
