"""What a clip of photographs is drawn of: layers, each a picture with a motion of its own."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

MOVING_S, RESTING_S = (0.05, 0.4), (0.05, 0.3)  # how long a spell of motion and a rest last
STOP_S = (0.05, 0.3)  # when a clip stops
FASTEST_WIDTHS_PER_S = 100.0  # frame widths a second that may be asked for


class SimilarityMotion:
    """Drift, sway, turn and zoom as functions of time in seconds.

    `speed_widths_per_s`: range of the speed, in frame widths a second: a drift of 0.6 of it and a
    sway of up to 0.4 along each axis, so that the middle of a picture moves by 0.67 of it in the
    mean.  Turn and zoom do not go with it: up to 0.8 rad/s and 0.3 a second; by them alone the
    points of a frame move by 0.09 widths a second in the mean.
    """

    def __init__(self, rng: np.random.Generator, speed_widths_per_s: Sequence[float]):
        slowest, fastest = speed_widths_per_s
        rate, heading = rng.uniform(slowest, fastest), rng.uniform(0, 2 * math.pi)
        self.drift = 0.6 * rate * np.array([math.cos(heading), math.sin(heading)])
        self.pace = 2 * math.pi * rng.uniform(0.3, 3.0, 4)  # rad/s of sway x, y, turn and zoom
        self.phase = rng.uniform(0, 2 * math.pi, 4)
        swing = np.array([0.4 * rate, 0.4 * rate, rng.uniform(0, 0.8), rng.uniform(0, 0.3)])
        self.amplitude = swing / self.pace  # so that `swing` is the largest speed of each
        self.angle = rng.uniform(-0.4, 0.4)

    def stop(self) -> None:
        """Stay as it is at t = 0."""
        self.drift, self.amplitude = 0 * self.drift, 0 * self.amplitude

    def shift_angle_log_zoom(self, time_s: float) -> tuple[NDArray, float, float]:
        """Return the shift (x, y) in frame widths, the angle in rad and the logarithm of zoom."""
        wave = self.amplitude * (np.sin(self.pace * time_s + self.phase) - np.sin(self.phase))
        return self.drift * time_s + wave[:2], self.angle + wave[2], wave[3]


def draw_motion_times_s(
    rng: np.random.Generator, times_s: Float[np.ndarray, " frames"]
) -> Float[np.ndarray, " frames"]:
    """Return how long a clip that rests has moved by `times_s`: a third of the clips move in spells
    with rests between, a third until they stop, a third never.
    """
    kind, moving_s, resting_s = rng.integers(3), rng.uniform(*MOVING_S), rng.uniform(*RESTING_S)
    phase_s, stop_s = rng.uniform(0, moving_s + resting_s), rng.uniform(*STOP_S)
    if kind > 0:
        return np.minimum(times_s, stop_s if kind == 1 else 0)
    spells, rest = np.divmod(phase_s + np.append(0, times_s), moving_s + resting_s)
    moved = spells * moving_s + np.minimum(rest, moving_s)
    return moved[1:] - moved[0]


@dataclass(frozen=True)
class MovingLayer:
    """A `picture`, and a `mask` where it is a cut-out; `frame_centre_in_picture`: its point (x, y)
    in the middle of the frame at t = 0, in its pixels; `picture_px_per_px` of the frame;
    `reenters`: it turns about its own middle and, once it has left the frame on one side, comes in
    on the other.
    """

    picture: NDArray
    mask: NDArray | None
    frame_centre_in_picture: NDArray
    picture_px_per_px: float
    motion: SimilarityMotion
    reenters: bool = False

    def frame_to_picture_matrix(
        self, time_s: float, size: tuple[int, int]
    ) -> Float[np.ndarray, "2 3"]:
        """Return the map from frame pixels (x, y) to picture pixels."""
        (height, width), scale = size, self.picture_px_per_px
        shift, angle, log_zoom = self.motion.shift_angle_log_zoom(time_s)
        cos, sin = math.cos(angle), math.sin(angle)
        turn = scale * math.exp(log_zoom) * np.array([[cos, -sin], [sin, cos]])
        start = self.frame_centre_in_picture
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        if not self.reenters:
            return np.column_stack([turn, start - shift * width * scale - turn @ middle])
        own = np.array(self.picture.shape[::-1]) / 2
        reach = max(self.picture.shape) / np.linalg.norm(turn[0])  # half of it is beyond the edge
        period = np.array([width, height]) + reach
        place = (own - start) / scale + shift * width + period / 2
        return np.column_stack([turn, own - turn @ (place % period - period / 2 + middle)])


def render_frame(
    layers: Sequence[MovingLayer], time_s: float, size: tuple[int, int]
) -> Float[np.ndarray, "h w"]:
    """Return the frame at `time_s`: the first layer with the others before it."""
    background, *cutouts = layers
    frame = _warp(background.picture, background.frame_to_picture_matrix(time_s, size), size)
    for layer in cutouts:
        matrix = layer.frame_to_picture_matrix(time_s, size)
        rows, columns = _visible_box(layer.picture.shape, matrix, size)
        behind = frame[rows, columns]
        if behind.size and layer.mask is not None:
            matrix[:, 2] += matrix[:, :2] @ (columns.start, rows.start)
            alpha = _warp(layer.mask, matrix, behind.shape, cv2.BORDER_CONSTANT)
            behind += alpha * (_warp(layer.picture, matrix, behind.shape) - behind)
    return frame


def blur_for_sampling(picture: NDArray, step_px: float) -> NDArray:
    """Return float32 in [0, 1], blurred for sampling every `step_px` without aliasing, and so that
    the bilinear interpolation does not flicker as the picture moves.
    """
    scale = 255 if picture.dtype == np.uint8 else 1
    return cv2.GaussianBlur(picture.astype(np.float32) / scale, (0, 0), max(0.6, 0.5 * step_px))


def random_outline_mask(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray:
    """Return a float32 mask, 1 inside a random smooth outline off the picture's border."""
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    angle = np.arctan2(y, x)
    radius = rng.uniform(0.5, 0.7)
    for order in range(2, 7):
        swing = rng.uniform(0, 0.3) / order
        radius = radius + swing * np.cos(order * angle + rng.uniform(0, 2 * math.pi))
    depth = 32 * (np.minimum(radius, 0.92) - np.hypot(x, y))
    mask = cv2.resize(depth.astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(mask, 0, 1)


def _visible_box(shape: tuple, matrix: NDArray, size: tuple[int, int]) -> tuple[slice, slice]:
    height, width = shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - matrix[:, 2]
    x, y = np.linalg.solve(matrix[:, :2], corners.T)
    rows, columns = (
        slice(max(0, int(line.min()) - 1), max(0, min(int(line.max()) + 2, n)))
        for line, n in ((y, size[0]), (x, size[1]))
    )
    return rows, columns


def _warp(
    picture: NDArray, matrix: NDArray, size: Sequence[int], border: int = cv2.BORDER_REFLECT_101
) -> NDArray:
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, matrix, size[::-1], flags=flags, borderMode=border)
