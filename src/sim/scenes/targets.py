"""Scenes whose motion is known exactly: what the paper's laboratory showed (figures 6, 9 and 11).

Every frame is drawn analytically, so that a shape moves by any part of a pixel without flicker.
Coordinates are pixels, the centre of a pixel is a whole number, y points down, angles are radians
and grow clockwise as seen.  A kind of target is a function of a canvas, a generator, which draws
where and when a clip starts, and arguments: lengths are shares of the frame's smaller side unless
stated otherwise.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import Parameter, signature
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from src.sim import noise
from src.sim.checks import check_in_range
from src.sim.scenes.clip import Clip, SceneBase

TURN = 2 * math.pi  # rad
FASTEST = 20_000.0  # px/s, beyond the dart of the paper; and turns/s
Map = Float[np.ndarray, "..."]
Rng = np.random.Generator
# From a time in seconds to brightness (h, w) in [0, 1], 0 where the ground is seen, the share
# (h, w) of each pixel that the shape covers, and the point (x, y) in pixels whose path is known.
DrawFunction = Callable[[float], tuple[NDArray, NDArray, tuple[float, float]]]


class Canvas:
    """The coordinates `x`, `y` (h, w) of a frame's pixels, its smaller `side` and its `centre`."""

    def __init__(self, size: tuple[int, int]):
        self.height, self.width = size
        self.side = min(size)
        self.centre = (self.width - 1) / 2, (self.height - 1) / 2
        self.x, self.y = np.meshgrid(np.arange(float(self.width)), np.arange(float(self.height)))

    def relative_to(self, x: float, y: float) -> tuple[NDArray, NDArray]:
        return self.x - x, self.y - y


def checkerboard(canvas: Canvas, rng: Rng, *, squares=8.0, speed_px_per_s=0.0) -> DrawFunction:
    """Upright squares of a side each 1 / `squares` that move.  Path: a corner near the middle."""
    pitch, heading = canvas.side / squares, rng.uniform(0, TURN)
    x0, y0 = np.array(canvas.centre) + rng.uniform(-0.5, 0.5, 2) * pitch

    def draw(time):
        x = x0 + speed_px_per_s * math.cos(heading) * time
        y = y0 + speed_px_per_s * math.sin(heading) * time
        across = antialiased_square_wave(canvas.x[:1] - x, pitch)
        board = 0.5 + 0.5 * antialiased_square_wave(canvas.y[:, :1] - y, pitch) * across
        return board, np.ones_like(board), (x, y)

    return draw


def rotating_dot(
    canvas: Canvas, rng: Rng, *, orbit_radius=0.3, dot_radius=0.05, turns_per_s=0.5
) -> DrawFunction:
    """A dot that circles the middle.  Path: its centre."""
    orbit, radius = orbit_radius * canvas.side, dot_radius * canvas.side
    start = rng.uniform(0, TURN)

    def draw(time):
        x, y = point_at(canvas.centre, orbit, start + TURN * turns_per_s * time)
        dot = disc_coverage(*canvas.relative_to(x, y), radius)
        return dot, dot, (x, y)

    return draw


def spinning_stripe(
    canvas: Canvas, rng: Rng, *, stripe_length=0.8, stripe_width=0.08, turns_per_s=0.5
) -> DrawFunction:
    """A stripe that turns about its middle.  Path: one end of it."""
    length, width = stripe_length * canvas.side, stripe_width * canvas.side
    start = rng.uniform(0, TURN)

    def draw(time):
        angle = start + TURN * turns_per_s * time
        along, across = to_body_coordinates(*canvas.relative_to(*canvas.centre), angle)
        shape = edge_coverage(length / 2 - abs(along)) * edge_coverage(width / 2 - abs(across))
        return shape, shape, point_at(canvas.centre, length / 2, angle)

    return draw


def spinning_disc(
    canvas: Canvas, rng: Rng, *, disc_radius=0.2, sectors=3, turns_per_s=0.5
) -> DrawFunction:
    """A turning disc of bright and dim sectors.  Path: where on the rim a bright sector begins."""
    radius, start = disc_radius * canvas.side, rng.uniform(0, TURN)

    def draw(time):
        angle = start + TURN * turns_per_s * time
        x, y = canvas.relative_to(*canvas.centre)
        cover = disc_coverage(x, y, radius)
        bright = sector_coverage(*to_body_coordinates(x, y, angle), int(sectors))
        return (0.35 + 0.65 * bright) * cover, cover, point_at(canvas.centre, radius, angle)

    return draw


def bouncing_ball(
    canvas: Canvas, rng: Rng, *, ball_radius=0.12, bounce_height=0.6, bounces_per_s=1.0,
    speed_widths_per_s=0.25,
) -> DrawFunction:  # fmt: skip
    """A striped ball that falls, bounces to a height and comes back, drifts (in frame widths) from
    wall to wall and rolls.  Path: its centre.
    """
    radius, height = ball_radius * canvas.side, bounce_height * canvas.side
    speed = speed_widths_per_s * canvas.width
    place, phase, angle = rng.uniform(0, 2), rng.uniform(0, 1), rng.uniform(0, TURN)
    free, floor = canvas.width - 1 - 2 * radius, canvas.height - 1 - radius

    def draw(time):
        # The way to and fro is a triangle wave; between bounces the height is a parabola.
        way = (place + speed * time / free) % 2
        along_floor = free * min(way, 2 - way)
        x = radius + along_floor
        y = floor - height * (1 - (2 * ((phase + bounces_per_s * time) % 1) - 1) ** 2)
        along, _ = to_body_coordinates(*canvas.relative_to(x, y), angle + along_floor / radius)
        ball = disc_coverage(*canvas.relative_to(x, y), radius)
        return (0.7 + 0.3 * antialiased_square_wave(along, radius / 2)) * ball, ball, (x, y)

    return draw


def dart(
    canvas: Canvas, rng: Rng, *, dart_length=0.25, dart_width=0.05, speed_px_per_s=1000.0
) -> DrawFunction:
    """A ringed dart that crosses near the middle on a straight line (the paper's: 16,000 px/s in
    12,000 fps), again and again.  Path: its middle.
    """
    length, width = dart_length * canvas.side, dart_width * canvas.side
    heading = rng.uniform(0, TURN)
    middle = np.array(canvas.centre) + rng.uniform(-0.2, 0.2, 2) * canvas.side
    # Half the diagonal and the dart away on either side it is out of sight, where it turns up.
    reach = math.hypot(canvas.height, canvas.width) / 2 + 0.3 * canvas.side + length
    start = rng.uniform(0.5, 0.8) * reach

    def draw(time):
        place = (start + speed_px_per_s * time) % (2 * reach) - reach
        x, y = point_at(middle, place, heading)
        along, across = to_body_coordinates(*canvas.relative_to(x, y), heading)
        beyond = np.maximum(abs(along) - (length - width) / 2, 0)
        body = edge_coverage(width / 2 - np.hypot(beyond, across))
        ring = edge_coverage(length / 20 - abs(along - length / 4))
        return body * (1 - 0.6 * ring), body, (x, y)

    return draw


def dot_grid(canvas: Canvas, rng: Rng, *, dots=3, dot_radius=0.05) -> DrawFunction:
    """`dots` x `dots` discs that stand still.  Path: the centre of the grid."""
    radius, number = dot_radius * canvas.side, int(dots)
    places = (np.arange(number) - (number - 1) / 2) * (canvas.side / number)
    x0, y0 = np.array(canvas.centre) + rng.uniform(-0.5, 0.5, 2)
    centres = [(x0 + x, y0 + y) for x in places for y in places]
    picture = np.sum([disc_coverage(*canvas.relative_to(*at), radius) for at in centres], 0)
    return lambda time: (picture, picture, (x0, y0))


KINDS = checkerboard, rotating_dot, spinning_stripe, spinning_disc, bouncing_ball, dart, dot_grid
TARGETS: dict[str, Callable[..., DrawFunction]] = {kind.__name__: kind for kind in KINDS}


@dataclass(kw_only=True, eq=False)
class Targets(SceneBase):
    """Clip `index` shows kind number `index` modulo their number, bright on a dark ground, grey
    levels 0.5 (1 -+ `contrast`); `options` holds arguments of one kind.

    Raises ValueError for another kind than those in TARGETS and for arguments out of their range.
    """

    kinds: Sequence[str]
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    contrast: float = 0.8

    def __post_init__(self) -> None:
        super().__post_init__()
        unknown = [name for name in (*self.kinds, *self.options) if name not in TARGETS]
        if unknown or not self.kinds:
            raise ValueError(f"scene.kinds must be some of {', '.join(TARGETS)}, got {unknown}")
        self.canvas = Canvas(self.size)
        for kind in self.kinds:
            given = self.options.get(kind, {})
            check_arguments(kind, given, self.canvas, f"scene.options.{kind}")

    def clip(self, index: int) -> Clip:
        turn, place = divmod(index, len(self.kinds))
        kind = self.kinds[place]
        name = kind.title().replace("_", "")
        rng = np.random.default_rng(noise.key(self.seed, self.split, name, turn))
        draw = TARGETS[kind](self.canvas, rng, **self.options.get(kind, {}))
        shapes, _, path = zip(*(draw(time) for time in self.times_s), strict=True)
        frames = (0.5 + self.contrast * (np.stack(shapes) - 0.5)).astype(np.float32)
        path_px = torch.tensor(path, dtype=torch.float32)
        return Clip(torch.from_numpy(frames), self.fps, f"{name}-{turn}", path_px)


def check_arguments(kind: str, arguments: Mapping[str, Any], canvas: Canvas, key: str) -> None:
    """Raise ValueError, which names `key` of the config, for an argument that a kind has not, or
    that is out of its range in frames of this size.
    """
    parameters = signature(TARGETS[kind]).parameters.items()
    own = {name: one.default for name, one in parameters if one.kind is Parameter.KEYWORD_ONLY}
    if not arguments.keys() <= own.keys():
        raise ValueError(f"{key} must hold {', '.join(own)}, got {', '.join(arguments)}")
    own |= arguments
    px = 1 / canvas.side
    limits = {
        "squares": (1.0, canvas.side / 2),
        "orbit_radius": (0.0, 0.5),
        "dot_radius": (px, 0.5 / max(own.get("dots", 1), 1)),
        "stripe_length": (px, 2.0),
        "stripe_width": (px, 1.0),
        "disc_radius": (2 * px, 0.5),
        "sectors": (1, 32),
        "ball_radius": (2 * px, 0.4),
        "bounce_height": (0.0, 1.0 - 2 * own.get("ball_radius", 0.0)),
        "bounces_per_s": (0.0, FASTEST),
        "dart_length": (2 * px, 1.0),
        "dart_width": (px, own.get("dart_length", 1.0)),
        "dots": (1, 64),
        "speed_px_per_s": (0.0, FASTEST),
        "speed_widths_per_s": (0.0, FASTEST / canvas.width),
        "turns_per_s": (-FASTEST, FASTEST),
    }
    frame = f"in frames of {canvas.width}x{canvas.height} px (scene.width, scene.height)"
    for name, value in own.items():
        try:
            check_in_range(f"{key}.{name}", value, *limits[name])
        except ValueError as error:
            raise ValueError(f"{error}, {frame}") from None


def edge_coverage(depth: Map) -> Map:
    """Return the share of a pixel that is inside, from how deep (px) its centre lies inside; exact
    for edges along rows or columns, off by at most 0.05 for slanting ones.
    """
    return np.clip(depth + 0.5, 0, 1)


def disc_coverage(x: Map, y: Map, radius: float) -> Map:
    """Return the share of the pixels at (x, y), seen from its centre, that a disc covers."""
    return edge_coverage(radius - np.hypot(x, y))


def antialiased_square_wave(place: Map, half_period: float) -> Map:
    """Return the mean over a pixel of stripes of +1 (from 0 on) and -1, each `half_period` wide;
    exact where the stripes run along rows or columns.
    """

    def integral(x: Map) -> Map:
        return half_period - abs(x % (2 * half_period) - half_period)

    return integral(place + 0.5) - integral(place - 0.5)


def sector_coverage(x: Map, y: Map, number: int) -> Map:
    """Return the share of the pixels at (x, y), seen from the middle of a disc, in one of `number`
    equal sectors, the first from angle 0 on, with gaps as wide between; off by at most 0.05 except
    within `number` pixels of the middle.
    """
    wide = math.pi / number
    from_middle = abs((np.arctan2(y, x) + wide / 2) % (2 * wide) - wide)  # of the nearest sector
    return edge_coverage(np.hypot(x, y) * np.sin(wide / 2 - from_middle))


def to_body_coordinates(x: Map, y: Map, angle: float) -> tuple[Map, Map]:
    """Return the coordinates (x, y) along and across a body that lies at `angle`."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * x + sin * y, cos * y - sin * x


def point_at(centre: Any, radius: float, angle: float) -> tuple[float, float]:
    """Return the point (x, y) at `radius` and `angle` from `centre` (x, y)."""
    return centre[0] + radius * math.cos(angle), centre[1] + radius * math.sin(angle)
