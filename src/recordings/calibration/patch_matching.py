"""Patches of one stack of pictures found in another, over all pictures at once, to parts of a
pixel."""

import cv2
import numpy as np
from jaxtyping import Float, Int

from src.recordings.calibration.view_field import Rectangle

MIN_LIKENESS = 0.4  # normalised correlation of a patch and its counterpart
MIN_STRENGTH = 0.1  # of the structure that the strongest tenth of the places have
MIN_ROUNDNESS = 0.08  # of the weaker to the stronger direction: along a straight edge all is alike
Stack = Float[np.ndarray, "n h w"]
Pixels = Int[np.ndarray, "places 2"]


def choose_places(pictures: Stack, tile: Rectangle, half: int) -> Pixels:
    """Return the (x, y) of patches of 2 `half` + 1 pixels in `tile`, half overlapping, that have
    structure in two directions."""
    low = np.maximum(tile[:2], 0) + half
    high = np.minimum(tile[2:], np.subtract(pictures.shape[:0:-1], 1)) - half
    spans = zip(np.ceil(low), high, strict=True)
    xs, ys = (np.arange(first, last, (half + 1) // 2) for first, last in spans)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2).astype(np.int64)
    x, y = places.T
    down, across = np.gradient(pictures, axis=(1, 2))
    products = ((across, across), (across, down), (across, down), (down, down))
    tensor = [_sum_patches(*pair, half)[y, x] for pair in products]
    weak, strong = np.linalg.eigvalsh(np.stack(tensor, axis=-1).reshape(-1, 2, 2)).T
    enough = weak > MIN_STRENGTH * np.percentile(weak, 90) if len(weak) else weak > 0
    return places[enough & (weak > MIN_ROUNDNESS * strong)]


def measure_patch_offsets(
    pictures: Stack, others: Stack, places: Pixels, half: int, reach: int
) -> Float[np.ndarray, "places 2"]:
    """Return how far from its place each patch of `pictures` lies in `others`, (x, y) in pixels, at
    most `reach` along each; NaN where it is not found."""
    first, last = places.min(0) - half, places.max(0) + half + 1  # in the picture, as `tile` is
    (x, y), (width, height) = (places - first).T, last - first
    within = np.s_[:, first[1] : last[1], first[0] : last[0]]
    wide = np.pad(others, ((0, 0), (reach, reach), (reach, reach)))
    wide = wide[:, first[1] : last[1] + 2 * reach, first[0] : last[0] + 2 * reach]
    here = pictures[within]
    own, energy = (_sum_patches(each, each, half) for each in (here, wide))
    own = own[y, x]
    side = 2 * reach + 1
    likeness = np.empty((len(places), side, side))
    for dy, dx in np.ndindex(side, side):
        product = _sum_patches(here, wide[:, dy : dy + height, dx : dx + width], half)
        scale = np.sqrt(np.maximum(own * energy[y + dy, x + dx], 1e-9))
        likeness[:, dy, dx] = product[y, x] / scale
    return _peaks(likeness)


def _sum_patches(one: np.ndarray, other: np.ndarray, half: int) -> np.ndarray:
    """Return the products of two stacks, summed over pictures and patches.

    Tests do not check the shapes, as this runs at every offset of a search.
    """
    size, border = (2 * half + 1,) * 2, cv2.BORDER_CONSTANT
    products = np.einsum("kyx,kyx->yx", one, other)
    return cv2.boxFilter(products, cv2.CV_64F, size, normalize=False, borderType=border)


def _peaks(likeness: Float[np.ndarray, "places d d"]) -> Float[np.ndarray, "places 2"]:
    """Return the place of each maximum from the middle, by a parabola along x and y; NaN where it
    is too low or at the border."""
    count, side, _ = likeness.shape
    best = np.unravel_index(likeness.reshape(count, -1).argmax(1), (side, side))
    y, x = (axis.clip(1, side - 2) for axis in best)
    each, shift = np.arange(count), []
    top = likeness[each, y, x]
    for dx, dy in ((1, 0), (0, 1)):
        before, after = likeness[each, y - dy, x - dx], likeness[each, y + dy, x + dx]
        shift.append((after - before) / 2 / np.maximum(2 * top - before - after, 1e-9))
    offset = np.stack([x + shift[0], y + shift[1]], axis=1) - (side - 1) / 2
    good = (y == best[0]) & (x == best[1]) & (top > MIN_LIKENESS)
    return np.where(good[:, None], offset, np.nan)
