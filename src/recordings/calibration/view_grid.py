"""Where the mirrored views of a kaleidoscope lie on the sensor, found in pictures of any scene.

Two neighbours are mirror images of each other about the seam between them.  The products of all
pairs of columns (then of rows) of the sensor, summed over pictures, are folded at every seam and
pitch: the right ones bring equal columns together.
"""

from dataclasses import dataclass, replace
from itertools import product
from operator import itemgetter

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from src.recordings.calibration.activity_pictures import extract_coarse_edges
from src.sim.optics import Position

MIN_SCORE = 0.2  # of the energy that neighbours share; other scenes have 0.1 at most
MIN_LIKENESS = 0.2  # of a view and its neighbour, 1 for equal ones
SEAM_LIKENESS = 0.5  # of what lies before a seam and behind it; other lines have 0.3
MAX_VIEWS = 10  # along an axis
WHOLE = 0.9  # share of a view that must lie on the sensor, or it is left out
OTHER_GRIDS = "a grid turned by more than a degree or views of unequal size"
Gram = Float[np.ndarray, "n n"]
Seams = float | Float[np.ndarray, " seams"]


@dataclass(frozen=True)
class ViewAxis:
    """Views along x or y, in pixels: the first begins at `start`, each is `pitch` long, `count` are
    whole.

    `score`: the products of mirrored neighbours over those of each line with itself.
    """

    start: float
    pitch: float
    count: int
    score: float

    @property
    def centre_index(self) -> int:
        """Index of the centre view; of an even number the one before the middle."""
        return (self.count - 1) // 2

    @property
    def outer_offsets(self) -> tuple[int, int]:
        """Return how many views the first and the last are from the centre one."""
        return -self.centre_index, self.count - 1 - self.centre_index

    @property
    def centre_view_edges(self) -> tuple[float, float]:
        """Where the centre view begins and ends."""
        begin = self.start + self.centre_index * self.pitch
        return begin, begin + self.pitch

    def mirror(self, offset: int) -> tuple[float, float]:
        """Return (a, b): pixel x of the view `offset` from the centre one shows what pixel
        a x + b of the centre one does."""
        begin, end = self.centre_view_edges
        if offset % 2:
            return -1.0, begin + end + offset * self.pitch
        return 1.0, -offset * self.pitch


@dataclass(frozen=True)
class ViewGrid:
    """The whole views of a sensor: `x` and `y` are the axes of columns and of rows; positions
    `left_out` have no view."""

    x: ViewAxis
    y: ViewAxis
    left_out: tuple[Position, ...] = ()

    @property
    def positions(self) -> list[Position]:
        """(row, col) from the centre view, row by row."""
        rows, cols = (range(-a.centre_index, a.count - a.centre_index) for a in (self.y, self.x))
        return [at for at in product(rows, cols) if at not in self.left_out]

    @property
    def centre_view_edges(self) -> tuple[float, float, float, float]:
        """The centre view's left, top, right and bottom edge."""
        (left, right), (top, bottom) = self.x.centre_view_edges, self.y.centre_view_edges
        return left, top, right, bottom

    def homography(self, position: Position) -> Float[np.ndarray, "3 3"]:
        """Return the map of a view's pixels to the centre one's, were all mirrors perfect."""
        (a, b), (c, d) = self.x.mirror(position[1]), self.y.mirror(position[0])
        return np.array([[a, 0, b], [0, c, d], [0, 0, 1]])


def find_grid(pictures: Float[np.ndarray, "*windows h w"]) -> ViewGrid:
    """Find the views of a sensor in pictures of what it saw.

    Raises ValueError where neither columns nor rows of views repeat, or repeat in other sizes.
    """
    structure, step = extract_coarse_edges(pictures)
    small = _level(structure)
    x = find_axis(np.einsum("kyx,kyz->xz", small, small, optimize=True))
    y = find_axis(np.einsum("kyx,kzx->yz", small, small, optimize=True))
    for name, axis in (("columns", x), ("rows", y)):
        if axis.count == 1 and axis.score >= MIN_SCORE:
            raise ValueError(
                f"recording must show two or more whole {name} of views, of one size within 10 %:"
                f" neighbours share {axis.score:.2f} of what they show, but less are found; use a"
                " board (target=)"
            )
    if x.count == 1 and y.count == 1:
        best = f"{max(x.score, y.score):.2f}"
        raise ValueError(
            f"recording must show mirrored views side by side: neighbours share {best} of what"
            f" they show, {MIN_SCORE} is needed; record more motion, as windows without any do not"
            f" help, or use a board (target=) for {OTHER_GRIDS}"
        )
    if y.count == 1:
        y = _one_view(small, x, y.score)
    elif x.count == 1:
        x = _one_view(small.transpose(0, 2, 1), y, x.score)
    x, y = (replace(a, start=a.start * step - 0.5, pitch=a.pitch * step) for a in (x, y))
    return ViewGrid(x, y)


def _level(pictures: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n h w"]:
    """Return the pictures over their local contrast, so that strong edges do not decide alone."""
    contrast = [np.sqrt(cv2.GaussianBlur(picture**2, (0, 0), 5.0)) for picture in pictures]
    return pictures / (np.stack(contrast) + pictures.std((1, 2), keepdims=True) + 1e-9)


def find_axis(gram: Gram) -> ViewAxis:
    """Find the views along an axis from the products of its lines; one view where none repeats."""
    n, total = len(gram), max(float(np.trace(gram)), 1e-9)
    size = np.sqrt(np.maximum(np.diag(gram), 0))
    grams = np.stack([gram, np.outer(size, size)])
    pitches = np.arange(max(n / MAX_VIEWS, 8), n / 2 / WHOLE, 0.5).tolist()
    tried = [(*_find_seam(grams, pitch), pitch) for pitch in pitches]
    _, shared, seam, pitch = max(tried, key=itemgetter(0), default=(0.0, 0.0, 0.0, float(n)))
    axis = _whole_views(gram, seam, pitch, score=shared / total)
    if axis.score >= MIN_SCORE and axis.count == 1:
        axis = _between_two_seams(gram, axis)
    return axis if axis.score >= MIN_SCORE and axis.count > 1 else ViewAxis(0.0, n, 1, axis.score)


def _find_seam(grams: Float[np.ndarray, "2 n n"], pitch: float) -> tuple[float, float, float]:
    """Return the seam at which lines and mirrored neighbours share most in `grams`, the products of
    lines and the largest these can be: how many and alike they are, what they share, and the seam.
    """
    seams = np.arange(0.0, pitch)
    shared, possible = _share(grams, seams, pitch).sum((-2, -1))
    many_and_alike = shared * np.abs(shared) / np.maximum(possible, 1e-9)
    best = int(np.argmax(many_and_alike))
    return float(many_and_alike[best]), float(shared[best]), float(seams[best])


def _between_two_seams(gram: Gram, axis: ViewAxis) -> ViewAxis:
    """Return the axis of three views of unequal size, as long as the centre one each, or `axis`
    where there are not just two lines about which the lines beside them are alike."""
    n, reach = len(gram), len(gram) // 8
    away, likeness = np.arange(reach), np.zeros(n)
    for seam in range(reach, n - reach + 1):
        before, after = seam - 1 - away, seam + away
        energy = gram[before, before].sum() * gram[after, after].sum()
        likeness[seam] = gram[before, after].sum() / max(np.sqrt(energy), 1e-9)
    highest = likeness == ndimage.maximum_filter1d(likeness, reach)
    seams = np.flatnonzero(highest & (likeness >= SEAM_LIKENESS)).astype(float)
    if len(seams) != 2:
        return axis
    pitch = float(seams[1] - seams[0])
    return ViewAxis(float(seams[0]) - pitch, pitch, 3, axis.score)


def _fold_lines(n: int, seam: Seams, pitch: float) -> Int[np.ndarray, "*seams views lines"]:
    """Return the lines of each view, mirrored in every second; -1 off the sensor."""
    first, last = np.ceil(np.max(seam) / pitch), np.ceil((n - np.min(seam)) / pitch)
    views = np.arange(-int(first), int(last))[:, None]
    along = np.arange(int(pitch)) + 0.5
    begin = np.asarray(seam)[..., None, None] + views * pitch
    lines = np.floor(begin + np.where(views % 2, pitch - along, along)).astype(int)
    return np.where((lines >= 0) & (lines < n), lines, -1)


def _share(
    grams: Float[np.ndarray, "*grams n n"], seam: Seams, pitch: float
) -> Float[np.ndarray, "*grams_and_seams pairs lines"]:
    """Return the products of each line and its mirror image in the next view."""
    lines = _fold_lines(grams.shape[-1], seam, pitch)
    one, other = lines[..., :-1, :], lines[..., 1:, :]
    return grams[..., one, other] * ((one >= 0) & (other >= 0))


def _whole_views(gram: Gram, seam: float, pitch: float, score: float) -> ViewAxis:
    """Return the axis of the views that are like a neighbour and lie on the sensor."""
    lines, shared = _fold_lines(len(gram), seam, pitch), _share(gram, seam, pitch)
    energy = np.where(lines >= 0, np.diag(gram)[lines], 0)
    both = np.where((lines[:-1] >= 0) & (lines[1:] >= 0), energy[:-1] * energy[1:], 0)
    pairs = shared.sum(1) > MIN_LIKENESS * np.maximum(np.sqrt(both).sum(1), 1e-9)
    start = seam - int(np.ceil(seam / pitch)) * pitch
    if pairs.sum() == 1:  # two views fit any pitch beyond what they show
        only = int(pairs.argmax())
        middle = start + (only + 1) * pitch
        reach = _reach(np.abs(lines[only] + 0.5 - middle), shared[only])
        reach = min(reach, middle, len(gram) - middle)
        return ViewAxis(float(middle - reach), float(reach), 2, score)
    like = np.append(pairs, False) | np.insert(pairs, 0, False)
    kept = np.flatnonzero(like & ((lines >= 0).mean(1) >= WHOLE))
    first, last = (kept[0], kept[-1]) if len(kept) else (0, 0)
    return ViewAxis(float(start + first * pitch), float(pitch), int(last - first) + 1, score)


def _reach(distance: Float[np.ndarray, " n"], shared: Float[np.ndarray, " n"]) -> float:
    """Return the distance within which 99 % of what is shared lies, and a twentieth more."""
    order = np.argsort(distance)
    total = np.maximum(shared[order], 0).cumsum()
    return 1.05 * float(distance[order][np.searchsorted(total, 0.99 * total[-1])])


def _one_view(pictures: Float[np.ndarray, "n h w"], across: ViewAxis, score: float) -> ViewAxis:
    """Return the axis of one row of views, as long as what neighbours in it share."""
    lines = _fold_lines(pictures.shape[2], across.start, across.pitch)
    folded = pictures[:, :, lines] * (lines >= 0)
    total = (folded[:, :, 1:] * folded[:, :, :-1]).sum((0, 2, 3)).cumsum()
    first, last = (int(np.argmax(total >= share * total[-1])) for share in (0.01, 0.99))
    more = (last + 1 - first) / 20
    begin, end = max(0.0, first - more), min(float(len(total)), last + 1 + more)
    return ViewAxis(begin, end - begin, 1, score)
