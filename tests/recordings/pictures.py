"""Calibration targets drawn with antialiasing, and a tilted dot grid, for the tests beside."""

import cv2
import numpy as np

SIDE, FINE = 240, 4


def _coordinates(angle: float) -> tuple[np.ndarray, np.ndarray]:
    y, x = (np.mgrid[: SIDE * FINE, : SIDE * FINE] + 0.5) / FINE - SIDE / 2
    return np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x


def _shrink(picture: np.ndarray) -> np.ndarray:
    return picture.reshape(SIDE, FINE, SIDE, FINE).mean((1, 3)).astype(np.float32)


def checkerboard(rows: int, cols: int, pitch: float = 24.0, angle: float = 0.05) -> np.ndarray:
    """Return (240, 240) in [0, 1] with `rows` x `cols` inner corners."""
    x, y = _coordinates(angle)
    i, j = np.floor(x / pitch + (cols + 1) / 2), np.floor(y / pitch + (rows + 1) / 2)
    board = (i >= 0) & (i <= cols) & (j >= 0) & (j <= rows)
    return _shrink(np.where(board, (i + j) % 2 * 0.8 + 0.1, 0.9))


def circles(rows: int, cols: int, pitch: float = 26.0, angle: float = 0.05) -> np.ndarray:
    """Return (240, 240) in [0, 1] with `rows` x `cols` dark dots."""
    x, y = _coordinates(angle)
    i, j = x / pitch + (cols - 1) / 2, y / pitch + (rows - 1) / 2
    nearest_i, nearest_j = np.clip(np.round(i), 0, cols - 1), np.clip(np.round(j), 0, rows - 1)
    return _shrink(np.where(np.hypot(i - nearest_i, j - nearest_j) < 0.3, 0.1, 0.9))


def charuco(squares: int = 6, pitch: int = 32) -> np.ndarray:
    """Return (240, 240) in [0, 1] with a board of 6x6 squares of DICT_4X4_50, markers of 0.7."""
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((squares, squares), 1.0, 0.7, book)
    large = board.generateImage((squares * pitch * FINE,) * 2).astype(np.float32) / 255
    edge = (SIDE - squares * pitch) // 2
    small = cv2.resize(large, (squares * pitch,) * 2, interpolation=cv2.INTER_AREA)
    return np.pad(small, edge, constant_values=0.95)


def dot_grid(centres: np.ndarray, sigma: np.ndarray, amplitude: np.ndarray, side: int = 96):
    """Return (frames, side, side): Gaussians of `centres` (frames, dots, 2) on a ground of 0.8."""
    axis = np.arange(side)
    across = np.exp(-((axis - centres[..., :1]) ** 2) / (2 * sigma[..., None] ** 2))
    down = np.exp(-((axis - centres[..., 1:]) ** 2) / (2 * sigma[..., None] ** 2))
    return 0.8 + np.einsum("fd,fdy,fdx->fyx", amplitude, down, across)
