"""Which photographs there are, which split each belongs to, and how one is read.

Many may lie in one file, a pack, which `python -m scripts.pack_scenes` writes: safetensors, under
each name an encoded picture (WebP or any other that OpenCV decodes) as uint8, under `index.json`
the index, {split: {name: [height, width, SHA-256 of the picture]}} in the order of the splits'
lists, and in the file's metadata `index_sha256`.  It is mapped, not read.
"""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from safetensors import SafetensorError, safe_open

from src.sim.scenes.clip import check_split
from src.sim.scenes.code_values import ALL_BITS, warn_of_darkness, warn_of_transparency
from src.sim.scenes.video_files import PICTURE_SUFFIXES, read_picture, walk_files

SHARES = {"train": (0, 1, 2, 3, 5, 6, 8), "val": (4,), "test": (7, 9)}  # of ten photographs
LARGEST_SIDE = 1024  # of a photograph in memory
KINDS = ", ".join(sorted(PICTURE_SUFFIXES))
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

    `root` None: those inside scikit-image.  Pictures of one stem in one folder are in one split.
    Raises ValueError where there are none, for a split that is none, and for a folder within
    another and a file found twice, by links, whose photographs would be in two splits.
    """
    check_split(split)
    if root is None:
        spec = find_spec("skimage")
        assert spec is not None and spec.origin is not None
        folder = Path(spec.origin).parent / "data"
        embedded = {path.stem: path for path in folder.iterdir() if path.suffix in PICTURE_SUFFIXES}
        return [embedded[name] for name in EMBEDDED[split].split()]
    roots = list_roots("root", root)
    found = _list_folders_apart(roots)
    return [photo for one in roots for photo in _share(one, found[one], split)]


def list_train_only_photographs(extra_train_root: Root, scene_root: Root) -> list[Photograph]:
    """Return the photographs that serve training only: all of a folder, of a pack its share.

    Raises ValueError where there are none, and where one of the two is within the other or they
    share a file, by links, as what `scene_root` keeps for validation and test would be trained on.
    """
    scene_roots = list_roots("root", scene_root)
    places = [one.resolve() for one in scene_roots]
    found: list[Photograph] = []
    extra: list[Path] = []
    for one in list_roots("extra_train_root", extra_train_root):
        here = one.resolve()
        if any(here.is_relative_to(place) or place.is_relative_to(here) for place in places):
            raise ValueError(f"scene.extra_train_root must be apart from scene.root, got {one}")
        paths = _list_pictures(one)
        extra += paths
        photos = _packed(one, "train") if one.is_file() else paths
        if not photos:
            wanted = "scene.extra_train_root must hold photographs"
            raise ValueError(f"{wanted}, got none in {one} ({KINDS} count)")
        found += photos
    _refuse_shared_files(extra, scene_roots)
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
    picture = read_luminance(photo)
    shrink = 1 if picture is None else min(1, LARGEST_SIDE / max(picture.shape))
    if picture is None or shrink * min(picture.shape) < 16:
        wanted = "readable photographs of 16 px or more, none cut short"
        raise ValueError(f"scene.root must hold {wanted}, got {photo}")
    if shrink < 1:
        picture = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return picture


def read_luminance(photo: Photograph) -> UInt8[np.ndarray, "h w"] | None:
    """Return a photograph's luminance in its own size, None for one that cannot be read or is cut
    short.  Warns, once in a process, of one that is nearly black or has transparent pixels.
    """
    source = photo.data() if isinstance(photo, PackedPhotograph) else photo
    picture = read_picture(source, ALL_BITS)
    if picture is None:
        return None
    _warn_once(photo, picture.dtype, float(picture.max()))
    return picture if picture.dtype == np.uint8 else read_picture(source)


@cache
def _warn_once(photo: Photograph, kind: np.dtype, largest: float) -> None:
    warn_of_darkness(str(photo), kind, largest, None, None)
    if isinstance(photo, Path):
        warn_of_transparency(photo)


def _list_folders_apart(roots: list[Path]) -> dict[Path, list[Path]]:
    """Return the pictures of each root; raises ValueError where two hold the same."""
    places = [one.resolve() for one in roots]
    for k, place in enumerate(places):
        if any(place.is_relative_to(other) for other in (*places[:k], *places[k + 1 :])):
            raise ValueError(f"scene.root must be folders apart, got {roots[k]} within another")
    found = {one: _list_pictures(one) for one in roots}
    paths = [path for one in roots for path in found[one]]
    first: dict[str, Path] = {}
    for file, path in zip(_locate(paths), paths, strict=True):
        if first.setdefault(file, path) is not path:
            wanted = "scene.root must hold each photograph once"
            raise ValueError(f"{wanted}, got {path}, which is {first[file]}")
    return found


def _share(root: Path, paths: list[Path], split: str) -> list[Photograph]:
    if root.is_file():
        photos = _packed(root, split)
        if not photos:
            raise ValueError(f"scene.root must hold photographs of split={split}, got {root}")
        return photos
    names = [os.path.splitext(path)[0] for path in paths]
    places = {name: place for place, name in enumerate(dict.fromkeys(names))}
    if len(places) < 10:
        found = f"{len(places)} in {root} ({KINDS} count)"
        raise ValueError(f"scene.root must hold at least 10 photographs, got {found}")
    pairs = zip(names, paths, strict=True)
    return [path for name, path in pairs if places[name] % 10 in SHARES[split]]


def _refuse_shared_files(extra: list[Path], scene_roots: list[Path]) -> None:
    if not extra:
        return
    paths = [path for one in scene_roots for path in _list_pictures(one)]
    held = dict(zip(_locate(paths), paths, strict=True))
    for file, path in zip(_locate(extra), extra, strict=True):
        if file in held:
            wanted = "scene.extra_train_root must be apart from scene.root"
            raise ValueError(f"{wanted}, got {path}, which is {held[file]}")


def _locate(paths: Iterable[Path]) -> list[str]:
    """Return the files that paths name, without links."""
    folders: dict[str, str] = {}
    files = []
    for path in paths:
        folder, name = os.path.split(path)
        if folder not in folders:
            folders[folder] = os.path.realpath(folder)
        file = f"{folders[folder]}/{name}"
        files.append(os.path.realpath(file) if os.path.islink(file) else file)
    return files


def _packed(pack: Path, split: str) -> list[Photograph]:
    return [PackedPhotograph(pack, name) for name in open_photo_pack(pack)[1].get(split, ())]


def _list_pictures(root: Path) -> list[Path]:
    """Return the pictures below a folder by name, none for a pack."""
    if root.is_file():
        return []
    return sorted(path for path in walk_files(root) if path.suffix.lower() in PICTURE_SUFFIXES)


def _read_checked(file: Any, path: Path, name: str, checksum: str) -> bytes:
    try:
        data = file.get_tensor(name).tobytes()
    except SafetensorError:
        data = b""
    if sha256(data).hexdigest() != checksum:
        reason = f"is damaged: the SHA-256 of {name} is not as packed"
        raise ValueError(f"scene.root: {path} {reason}")
    return data
