"""What a clip of photographs is drawn of: a background and cut-outs, each with its own motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from src.sim.scenes.motion import Motion


@dataclass(frozen=True)
class Layer:
    """A `picture`, and a `mask` where it is a cut-out; `centre`: the picture's point in the middle
    of the frame at t = 0; `zoom`: picture pixels per frame pixel.
    """

    picture: NDArray
    mask: NDArray | None
    centre: NDArray
    zoom: float
    motion: Motion

    def matrix(self, time: float, size: tuple[int, int]) -> NDArray:
        """Return the 2x3 map from frame pixels to picture pixels."""
        height, width = size
        shift, turn = self.moved(time)
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        offset = self.centre - shift * width * self.zoom - turn @ middle
        return np.column_stack([turn, offset])

    def moved(self, time: float) -> tuple[NDArray, NDArray]:
        """Return the shift (x, y) in frame widths and the 2x2 map of turn and zoom."""
        shift, angle, log_zoom = self.motion.at(time)
        scale = self.zoom * math.exp(log_zoom)
        cos, sin = math.cos(angle), math.sin(angle)
        return shift, scale * np.array([[cos, -sin], [sin, cos]])


class ReturningLayer(Layer):
    """A cut-out that turns about its own middle and, once it has left the frame on one side, comes
    in on the other.
    """

    def matrix(self, time: float, size: tuple[int, int]) -> NDArray:
        """Return the 2x3 map from frame pixels to picture pixels."""
        height, width = size
        shift, turn = self.moved(time)
        own = np.array(self.picture.shape[::-1]) / 2
        reach = max(self.picture.shape) / np.linalg.norm(turn[0])  # half of it is beyond the edge
        room = np.array([width, height]) + reach
        place = (own - self.centre) / self.zoom + shift * width + room / 2
        middle = place % room - room / 2 + np.array([(width - 1) / 2, (height - 1) / 2])
        return np.column_stack([turn, own - turn @ middle])


def render(layers: Sequence[Layer], time: float, size: tuple[int, int]) -> NDArray:
    """Return the frame (h, w) at `time`: the first layer with the others before it."""
    background, *cutouts = layers
    frame = _warp(background.picture, background.matrix(time, size), size)
    for layer in cutouts:
        matrix = layer.matrix(time, size)
        rows, columns = _seen(layer.mask.shape, matrix, size)
        behind = frame[rows, columns]
        if behind.size:
            matrix[:, 2] += matrix[:, :2] @ (columns.start, rows.start)
            alpha = _warp(layer.mask, matrix, behind.shape, cv2.BORDER_CONSTANT)
            behind += alpha * (_warp(layer.picture, matrix, behind.shape) - behind)
    return frame


def smooth(picture: NDArray, zoom: float) -> NDArray:
    """Return float32 in [0, 1], blurred for sampling every `zoom` pixels without aliasing.

    The blur also hides the interpolation: bilinear sampling between pixels of a sharp picture
    flickers as it moves, and a flicker makes events.
    """
    scale = 255 if picture.dtype == np.uint8 else 1
    return cv2.GaussianBlur(picture.astype(np.float32) / scale, (0, 0), max(0.6, 0.5 * zoom))


def blob(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray:
    """Return a mask, 1 inside a random smooth outline that keeps off the picture's border."""
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    angle = np.arctan2(y, x)
    radius = rng.uniform(0.5, 0.7)
    for order in range(2, 7):
        swing = rng.uniform(0, 0.3) / order
        radius = radius + swing * np.cos(order * angle + rng.uniform(0, 2 * math.pi))
    inside = 32 * (np.minimum(radius, 0.92) - np.hypot(x, y))
    mask = cv2.resize(inside.astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(mask, 0, 1)


def _seen(shape: tuple[int, ...], matrix: NDArray, size: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of the frame that a picture of `shape` can touch."""
    height, width = shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - matrix[:, 2]
    x, y = np.linalg.solve(matrix[:, :2], corners.T)
    spans = ((y.min(), y.max(), size[0]), (x.min(), x.max(), size[1]))
    return tuple(
        slice(max(0, int(low) - 1), max(0, min(int(high) + 2, n))) for low, high, n in spans
    )


def _warp(
    picture: NDArray, matrix: NDArray, size: Sequence[int], border: int = cv2.BORDER_REFLECT_101
) -> NDArray:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, matrix, size[::-1], flags=flags, borderMode=border)
