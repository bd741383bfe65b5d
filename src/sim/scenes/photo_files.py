"""Which photographs there are, which split each belongs to, and how one is read."""

from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import cv2
from numpy.typing import NDArray

from src.sim.scenes.photo_pack import Packed, listed
from src.sim.scenes.pictures import decode_picture, read_picture

SPLITS = ("train", "val", "test")
SHARES = {"train": (0, 1, 2, 3, 5, 6, 8), "val": (4,), "test": (7, 9)}  # of ten photographs
SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff"}
LARGEST_SIDE = 1024  # of a photograph in memory

# The photographs inside the scikit-image wheel; no split shares one with another, each has scenes
# and textures.
EMBEDDED = {
    "train": "astronaut brick camera coffee grass hubble_deep_field moon motorcycle_left retina",
    "val": "coins",
    "test": "chelsea gravel rocket",
}

Photo = Path | Packed
Root = str | Sequence[str] | None


def check_split(split: str) -> None:
    """Raise ValueError for a split that is none."""
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split}")


def photographs(root: Root, split: str) -> list[Photo]:
    """Return the photographs of a split: of several folders or packs, each one's own share of it.

    `root` None: those inside scikit-image.  Raises ValueError where there are none, and for a split
    that is none.
    """
    check_split(split)
    if root is None:
        folder = Path(find_spec("skimage").origin).parent / "data"
        embedded = {path.stem: path for path in folder.iterdir() if path.suffix in SUFFIXES}
        return [embedded[name] for name in EMBEDDED[split].split()]
    return [photo for one in _roots("root", root) for photo in _share(one, split)]


def only_for_training(train_root: Root, root: Root) -> list[Photo]:
    """Return the photographs that serve training only: all of a folder, of a pack its share.

    Raises ValueError where there are none, and where one of the two is within the other, as what
    `root` keeps for validation and test would be trained on.
    """
    if train_root is None:
        return []
    places = [] if root is None else [one.resolve() for one in _roots("root", root)]
    found: list[Photo] = []
    for one in _roots("train_root", train_root):
        here = one.resolve()
        if any(here.is_relative_to(place) or place.is_relative_to(here) for place in places):
            raise ValueError(f"scene.train_root must be apart from scene.root, got {one}")
        photos = listed(one, "train") if one.is_file() else _pictures(one)
        if not photos:
            raise ValueError(f"scene.train_root must hold photographs, got none in {one}")
        found += photos
    return found


def _roots(key: str, root: str | Sequence[str]) -> list[Path]:
    roots = [Path(one) for one in ([root] if isinstance(root, str) else root)]
    if not roots:
        raise ValueError(f"scene.{key} must be a folder or a pack, or some, got an empty list")
    for one in roots:
        if not one.exists():
            raise ValueError(f"scene.{key} must be a folder or a pack of photographs, got {one}")
    return roots


def _share(root: Path, split: str) -> list[Photo]:
    if root.is_file():
        photos = listed(root, split)
        if not photos:
            raise ValueError(f"scene.root must hold photographs of split={split}, got {root}")
        return photos
    paths = _pictures(root)
    if len(paths) < 10:
        raise ValueError(
            f"scene.root must hold at least 10 photographs, got {len(paths)} in {root}"
        )
    return [path for place, path in enumerate(paths) if place % 10 in SHARES[split]]


def _pictures(folder: Path) -> list[Photo]:
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)


@lru_cache(maxsize=512)
def read(photo: Photo) -> NDArray:
    """Return a photograph's luminance as uint8, at most LARGEST_SIDE long.

    Raises ValueError for one that cannot be read or is damaged, and for a side below 16 px.
    """
    whole = isinstance(photo, Packed)
    picture = decode_picture(photo.data()) if whole else read_picture(photo)
    shrink = 1 if picture is None else min(1, LARGEST_SIDE / max(picture.shape))
    if picture is None or shrink * min(picture.shape) < 16:
        raise ValueError(f"scene.root must hold readable photographs of 16 px or more, got {photo}")
    if shrink < 1:
        picture = cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return picture
