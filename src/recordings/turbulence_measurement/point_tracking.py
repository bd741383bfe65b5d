"""Points of a still scene, tracked through frames that turbulence moved (Lucas & Kanade 1981).

The template is the mean frame, shifted; frames are never interpolated.  A window of a frame, a
shift and a change of contrast and brightness of the template are fitted to each other by
Gauss-Newton steps from OpenCV's optical flow.  From there the two colours of a chessboard of pixels
are fitted each by itself until it converges: their noise is independent, so that the product of the
two displacements estimates the power of the motion without that of the noise.
"""

import copy
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

SPREAD, REACH = 2.0, 5  # pixels: deviation and half width of the Gaussian window
STEPS, COLOUR_STEPS = 4, 8  # of both colours together, then of each by itself at most
CONVERGED_PX = 0.005  # a point whose step is shorter is done
MAX_STEP = 2.0  # pixels
MIN_EXPLAINED = 0.8  # of a window's variance, or the point is lost in that frame
MAX_RELATIVE = 4.0  # times the typical displacement: further off is another part of the scene
MAX_CORNERS, QUALITY, MIN_DISTANCE = 800, 0.003, 4  # corners: number, weakest over best, px apart
MIN_ROUNDNESS = 0.2  # of a corner: power along the weaker over that along the stronger direction
MARGIN = 12  # pixels at the frame's edge without corners
WINDOW_SIDE = 2 * (REACH + 3) + 1  # pixels of a window of the mean over frames
COARSEST = 64  # pixels of the shorter side at the coarsest level


@dataclass(frozen=True)
class PointTracks:
    """Points that were tracked, in pixels of the frames given.

    `place`: x and y in the mean frame; `moved`: the displacement from there, estimated twice;
    `sharp`, twice: how much of the mean frame's gradient a window shows (1: all, more: sharper);
    `texture`: the power of that gradient, `curvature`: its product with that of the Laplacian, less
    than zero (blur by a Gaussian of variance v changes the gradient by v / 2 times that);
    `seen`: in which frames a point was found, others hold 0; `window_variance_px2`: the variance
    along one axis of what a displacement is the mean over.
    """

    place: Float[np.ndarray, "points 2"]
    moved: Float[np.ndarray, "2 frames points 2"]
    sharp: Float[np.ndarray, "2 frames points"]
    texture: Float[np.ndarray, " points"]
    curvature: Float[np.ndarray, " points"]
    seen: Bool[np.ndarray, "frames points"]
    window_variance_px2: float

    def select(self, chosen: Bool[np.ndarray, " points"]) -> "PointTracks":
        """Return the tracks of some of the points."""
        moved, sharp = self.moved[:, :, chosen], self.sharp[:, :, chosen]
        place, texture, curvature = self.place[chosen], self.texture[chosen], self.curvature[chosen]
        seen, variance = self.seen[:, chosen], self.window_variance_px2
        return PointTracks(place, moved, sharp, texture, curvature, seen, variance)


def find_corners(picture: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "points 2"]:
    """Return whole-pixel corners of a picture in [0, 1], not near its edge; perhaps none.

    Points on straight edges are left out: along an edge any displacement fits.
    """
    inside = np.zeros(picture.shape, np.uint8)
    inside[MARGIN:-MARGIN, MARGIN:-MARGIN] = 255
    eight_bits = np.clip(picture * 255, 0, 255).astype(np.uint8)
    peaks = cv2.goodFeaturesToTrack(
        eight_bits, 4 * MAX_CORNERS, QUALITY, MIN_DISTANCE, mask=inside, blockSize=5
    )
    if peaks is None:
        return np.zeros((0, 2), np.float32)
    x, y = np.round(peaks[:, 0]).astype(int).T
    gx, gy = _gradient(picture)
    xx, xy, yy = (cv2.GaussianBlur(g, (0, 0), SPREAD)[y, x] for g in (gx * gx, gx * gy, gy * gy))
    half, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    is_corner = half - spread > MIN_ROUNDNESS * (half + spread)
    return np.stack([x, y], axis=1)[is_corner][:MAX_CORNERS].astype(np.float32)


def track_points(
    frames: Float[np.ndarray, "frames h w"], place: Float[np.ndarray, "points 2"]
) -> PointTracks:
    """Track the points `place`, whole pixels of the mean frame, into every frame: with windows of
    the mean frame, then with the mean of the windows that were found, which is sharper."""
    picture = frames.mean(0)
    rough = np.stack([_optical_flow(picture, frame, place) for frame in frames])
    halves = [_registered(frames[k::2], place, rough[k::2]) for k in (0, 1)]
    fine = _Windows((halves[0] + halves[1]) / 2, _window_centres(len(place)), place)
    refined = [_refine(fine, frame, start) for frame, start in zip(frames, rough, strict=True)]
    moved, sharp, explained = map(np.stack, zip(*refined, strict=True))
    seen = explained > MIN_EXPLAINED
    far = np.hypot(*moved.mean(1).transpose(2, 0, 1))
    typical = np.median(far[seen]) / 1.18 if seen.any() else 0.0  # of a Rayleigh distribution
    seen &= far < MAX_RELATIVE * typical + 0.5
    return PointTracks(
        place=place,
        moved=np.where(seen[..., None], moved.swapaxes(0, 1), 0),
        sharp=np.where(seen, sharp.swapaxes(0, 1), 0),
        texture=fine.texture,
        curvature=_curvature(halves, fine),
        seen=seen,
        window_variance_px2=fine.window_variance_px2,
    )


def _optical_flow(picture: np.ndarray, frame: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return displacements (points, 2) from `picture` to `frame`, to be refined; 0 where lost."""
    levels = int(np.log2(max(min(frame.shape) / COARSEST, 1)))
    before, after = (np.clip(p * 255, 0, 255).astype(np.uint8) for p in (picture, frame))
    found, is_found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, place, place.copy(), winSize=(2 * REACH + 1,) * 2, maxLevel=levels
    )
    return np.where(is_found, found - place, 0).astype(np.float32)


def _registered(frames: np.ndarray, place: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the windows' means over the frames, each where it was found, as one tall picture."""
    half = WINDOW_SIDE // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    total = np.zeros((len(place), WINDOW_SIDE**2), np.float32)
    for frame, away in zip(frames, moved, strict=True):
        total = total + _sample(frame, place + away, u, v)
    return (total / len(frames)).reshape(len(place) * WINDOW_SIDE, WINDOW_SIDE)


def _window_centres(points: int) -> np.ndarray:
    """Return x and y of the windows' centres in the tall picture of `_registered`."""
    half = WINDOW_SIDE // 2
    return np.stack([np.full(points, half), np.arange(points) * WINDOW_SIDE + half], axis=1)


def _curvature(halves: list[np.ndarray], windows: "_Windows") -> np.ndarray:
    """Return the product (points,) of gradient and the Laplacian's gradient, in the `windows` of
    two pictures of the same, whose noise is independent."""
    fields = (_gradient(halves[0]), _gradient(cv2.Laplacian(halves[1], -1)))
    ours, theirs = (
        np.stack([_sample(axis, windows.home, windows.u, windows.v) for axis in field])
        for field in fields
    )
    return (ours * theirs).sum((0, 2))


def _refine(
    windows: "_Windows", frame: np.ndarray, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return displacement (2, points, 2), sharpness (2, points), explained variance (points,)."""
    for _ in range(STEPS):
        moved = moved + windows.step(frame, moved)[0]
    halves = [_refine_colour(windows, frame, moved, colour) for colour in (0, 1)]
    sharp = [windows.sharpness(frame, moved, colour) for colour in (0, 1)]
    return np.stack(halves), np.stack(sharp), windows.step(frame, moved)[1]


def _refine_colour(
    windows: "_Windows", frame: np.ndarray, start: np.ndarray, colour: int
) -> np.ndarray:
    """Return the displacements (points, 2) in pixels at which the pixels of one `colour` fit best.

    One step from `start`, the optimum of both colours, is not enough: central differences are less
    than the slope of an edge, so that it is too long, and the noise of the two is anticorrelated.
    """
    moved, moving = start.copy(), np.arange(len(start))
    for _ in range(COLOUR_STEPS):
        step = windows.select(moving).step(frame, moved[moving], colour)[0]
        moved[moving] += step
        moving = moving[np.hypot(*step.T) > CONVERGED_PX]
        if not moving.size:
            break
    return moved


class _Windows:
    """Windows of a picture around `home`, to be found in frames near `place`, both whole pixels."""

    def __init__(self, picture: np.ndarray, home: np.ndarray, place: np.ndarray):
        self.home, self.place = home.astype(np.float32), place.astype(np.float32)
        self.fields = (picture, *_gradient(picture))
        self.v, self.u = v, u = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1].reshape(2, -1)
        self.weight = np.exp(-(u**2 + v**2) / (2 * SPREAD**2)).astype(np.float32)
        self.colour = (u + v) % 2
        power = np.sum([_sample(field, self.home, u, v) ** 2 for field in self.fields[1:]], axis=0)
        self.texture = power.sum(1)
        share = power * self.weight
        share /= np.maximum(share.sum(1, keepdims=True), 1e-12)
        spread = share @ (u**2 + v**2) - (share @ u) ** 2 - (share @ v) ** 2
        self.window_variance_px2 = float(spread.mean() / 2)

    def select(self, points: np.ndarray) -> "_Windows":
        """Return the windows of some of the points, to take steps with."""
        some = copy.copy(self)
        some.home, some.place = self.home[points], self.place[points]
        return some

    def step(
        self, frame: np.ndarray, moved: np.ndarray, colour: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a Gauss-Newton step from `moved`, and the share of variance explained there:
        frame = gain (template - step . gradient) + constant, in the pixels of one `colour`."""
        seen, weight, (picture, gx, gy) = self._pair(frame, moved, self.fields)
        if colour is not None:
            weight = weight * (self.colour == colour)
        total = np.maximum(weight.sum(1, keepdims=True), 1e-6)
        terms = np.stack([seen, gx, gy, picture], axis=1)
        terms -= (terms * weight[:, None]).sum(2, keepdims=True) / total[:, None]
        products = (terms * weight[:, None]) @ terms.swapaxes(1, 2)
        matrix, vector = products[:, 1:, 1:], products[:, 1:, :1]
        floor = 1e-6 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] + 1e-12
        slope = np.linalg.solve(matrix + floor * np.eye(3), vector)
        gain = slope[:, 2]
        steps = -slope[:, :2, 0] / np.where(np.abs(gain) > 0.1, gain, np.inf)
        explained = (slope * vector).sum((1, 2)) / np.maximum(products[:, 0, 0], 1e-12)
        return np.clip(steps, -MAX_STEP, MAX_STEP), np.where(gain[:, 0] > 0, explained, 0)

    def sharpness(self, frame: np.ndarray, moved: np.ndarray, colour: int) -> np.ndarray:
        """Return the slope of the frame's gradient over the template's, in the pixels of a colour
        (a central difference at one colour reads pixels of the other only)."""
        total = np.zeros((2, len(self.place)), np.float32)
        for ours, field in zip(_gradient(frame), self.fields[1:], strict=True):
            seen, weight, (wanted,) = self._pair(ours, moved, (field,))
            mine = (weight > 0) & (self.colour == colour)
            total = total + np.stack([(seen * wanted * mine).sum(1), (wanted**2 * mine).sum(1)])
        return total[0] / np.maximum(total[1], 1e-12)

    def _pair(
        self, frame: np.ndarray, moved: np.ndarray, fields: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return the frame's windows, their weights, and the fields' windows that fall there."""
        whole = np.round(moved)
        at = (self.place + whole).astype(int)
        height, width = frame.shape
        if at.min(initial=REACH) >= REACH and (at + REACH < (width, height)).all():
            first, offsets = at[:, :1] + at[:, 1:] * width, self.u + self.v * width
            seen = frame.ravel()[first + offsets]
            weight = np.repeat(self.weight[None], len(at), axis=0)
        else:
            x, y = at[:, :1] + self.u, at[:, 1:] + self.v
            seen = frame[y.clip(0, height - 1), x.clip(0, width - 1)]
            weight = self.weight * ((x >= 0) & (x < width) & (y >= 0) & (y < height))
        there = _window_pixels(self.home + (whole - moved), self.u, self.v)
        return seen, weight, [_sample_at(field, *there) for field in fields]


def _sample(picture: np.ndarray, at: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the picture (points, pixels) at `at` + (u, v), cubic; beyond the edge it is held."""
    return _sample_at(picture, *_window_pixels(at, u, v))


def _window_pixels(at: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (points, pixels) of `at` + (u, v)."""
    return (at[:, 0, None] + u).astype(np.float32), (at[:, 1, None] + v).astype(np.float32)


def _sample_at(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def _gradient(picture: Float[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """Return central differences along x and y."""
    across = np.array([[-0.5, 0, 0.5]], np.float32)
    return cv2.filter2D(picture, -1, across), cv2.filter2D(picture, -1, across.T)
