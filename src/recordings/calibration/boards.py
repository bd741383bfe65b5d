"""Calibration targets: the points of a checkerboard, circle grid or ChArUco board in a picture.

`detect_candidate_points` finds points of a kind of target anywhere in a picture that shows it many
times, mirrored or not; `find_points` those of the one target in a crop row by row, NaN where one is
not seen, or None.  `shape`: (rows, columns) of these; `candidate_count`: candidates on a whole
target; one that is `ordered` knows which point is which and is not found in a mirrored picture.
Pictures are (h, w) uint8; points are (x, y) pixels, (0, 0) the centre of the top left pixel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

Picture = UInt8[np.ndarray, "h w"]
Points = Float[np.ndarray, "_ 2"]


def check_grid_size(rows: int, cols: int, config_key: str = "target") -> None:
    """Raise ValueError, which names the keys below `config_key`, for a grid that is none."""
    if not (3 <= rows <= 100 and 3 <= cols <= 100):
        keys = f"{config_key}.rows and {config_key}.cols"
        raise ValueError(f"{keys} must be in 3..100, got {rows} and {cols}")


@dataclass(frozen=True)
class _Grid:
    rows: int = 5
    cols: int = 7
    ordered = False

    def __post_init__(self):
        check_grid_size(self.rows, self.cols)

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    @property
    def candidate_count(self) -> int:
        return self.rows * self.cols


class Checkerboard(_Grid):
    """`rows` x `cols` inner corners, each at least 3."""

    def detect_candidate_points(self, picture: Picture) -> Points:
        """Saddle points: where the Hessian's determinant is most negative for the contrast there.

        The threshold is half of what the corners of four whole boards have in the median.
        """
        smooth = ndimage.gaussian_filter(picture.astype(np.float64), 2.0)
        dy, dx = np.gradient(smooth)
        yy, yx = np.gradient(dy)
        mean = ndimage.gaussian_filter(smooth, 6.0)
        contrast = ndimage.gaussian_filter(smooth**2, 6.0) - mean**2
        contrast += 0.1 * np.percentile(contrast, 99)
        saddle = (yx**2 - yy * np.gradient(dx, axis=1)) / np.maximum(contrast, 1e-9)
        peaks = saddle == ndimage.maximum_filter(saddle, size=7)
        strongest = np.sort(saddle[peaks])[::-1][: 4 * self.candidate_count]
        y, x = np.nonzero(peaks & (saddle > 0.5 * np.median(strongest)))
        return np.stack([x, y], axis=1).astype(np.float64)

    def find_points(self, picture: Picture) -> Points | None:
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        complete, points = cv2.findChessboardCornersSB(picture, (self.cols, self.rows), flags=flags)
        return points.reshape(-1, 2).astype(np.float64) if complete else None


@dataclass(frozen=True)
class Circles(_Grid):
    """`rows` x `cols` dots on a square lattice, each at least 3; `dark` dots on a bright ground."""

    dark: bool = True

    def detect_candidate_points(self, picture: Picture) -> Points:
        spots = self._detector().detect(self._dark(picture))
        return np.array([spot.pt for spot in spots], dtype=np.float64).reshape(-1, 2)

    def find_points(self, picture: Picture) -> Points | None:
        flags = cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
        complete, points = cv2.findCirclesGrid(
            self._dark(picture), (self.cols, self.rows), flags=flags, blobDetector=self._detector()
        )
        return points.reshape(-1, 2).astype(np.float64) if complete else None

    def _dark(self, picture: Picture) -> Picture:
        return picture if self.dark else 255 - picture

    @staticmethod
    def _detector() -> cv2.SimpleBlobDetector:
        settings = cv2.SimpleBlobDetector.Params()
        settings.minArea, settings.maxArea = 12.0, 5000.0
        settings.minDistBetweenBlobs = 4.0
        settings.minCircularity, settings.filterByCircularity = 0.6, True
        return cv2.SimpleBlobDetector.create(settings)


@dataclass(frozen=True)
class Charuco(_Grid):
    """A ChArUco board of `rows` x `cols` squares; a marker's side is `marker` of a square's."""

    rows: int = 6
    cols: int = 6
    marker: float = 0.7
    dictionary: str = "DICT_4X4_50"
    ordered = True

    def __post_init__(self):
        super().__post_init__()
        if not 0 < self.marker < 1:
            raise ValueError(f"target.marker must be in (0, 1), got {self.marker}")
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise ValueError(f"target.dictionary must be one of OpenCV's, got {self.dictionary}")

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows - 1, self.cols - 1

    @property
    def candidate_count(self) -> int:
        return self.rows * self.cols // 2

    def detect_candidate_points(self, picture: Picture) -> Points:
        """Markers of both hands: those of the picture and of the picture mirrored in x."""
        detector = cv2.aruco.ArucoDetector(self._board().getDictionary())
        plain = _middles(detector.detectMarkers(picture)[0])
        mirrored = _middles(detector.detectMarkers(cv2.flip(picture, 1))[0])
        mirrored[:, 0] = picture.shape[1] - 1 - mirrored[:, 0]
        return np.concatenate([plain, mirrored])

    def find_points(self, picture: Picture) -> Points | None:
        corners, names, *_ = cv2.aruco.CharucoDetector(self._board()).detectBoard(picture)
        if names is None or len(names) < 6:
            return None
        points = np.full((self.shape[0] * self.shape[1], 2), np.nan)
        points[names.ravel()] = self._refine(picture, corners)
        return points

    def _refine(self, picture: Picture, corners: np.ndarray) -> Points:
        """Move corners to their saddles, within what is free of markers around them."""
        corners = corners.reshape(-1, 2).astype(np.float32, copy=True)
        square = np.median(cKDTree(corners).query(corners, k=2)[0][:, 1])
        reach = max(2, int((1 - self.marker) / 2 * square))
        until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-3)
        smooth = cv2.GaussianBlur(picture, (0, 0), 1.5)
        cv2.cornerSubPix(smooth, corners, (reach, reach), (-1, -1), until)  # in place
        return corners.astype(np.float64)

    def _board(self) -> cv2.aruco.CharucoBoard:
        book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.cols, self.rows), 1.0, self.marker, book)


Target = Checkerboard | Circles | Charuco


def cluster_points(points: Points, expected: int) -> list[Points]:
    """Return the clusters of `points` that have half to twice `expected` members: linked are those
    closer than 1.3 times the median distance of nearest neighbours."""
    if len(points) < expected:
        return []
    tree = cKDTree(points)
    nearest = np.median(tree.query(points, k=2)[0][:, 1])
    links = tree.sparse_distance_matrix(tree, 1.3 * nearest)
    count, label = connected_components(links, directed=False)
    clusters = [points[label == name] for name in range(count)]
    return [cluster for cluster in clusters if expected / 2 <= len(cluster) <= 2 * expected]


def _middles(markers: Sequence[np.ndarray]) -> Points:
    return np.array([marker.reshape(4, 2).mean(0) for marker in markers]).reshape(-1, 2)
