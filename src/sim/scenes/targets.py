"""Scenes whose motion is known exactly: what the paper's laboratory showed (figures 6 to 10).

Every frame is drawn analytically, so that a shape moves by any part of a pixel without flicker.
Lengths are shares of the frame's smaller side unless stated otherwise; coordinates are those of
shapes.py.  `truth` is the path of the point that a class names, in pixels.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from src.sim.scenes.drawing import FASTEST, Target, check_range
from src.sim.scenes.photographs import Clip
from src.sim.scenes.shapes import disc, inside, polar, sectors, stripes, turned


class Checkerboard(Target):
    """Upright squares of a side each 1 / `squares`; moves `speed` px/s in some direction, 0 stays.

    Truth: a corner near the middle.
    """

    def __init__(self, *, squares: float = 8.0, speed: float = 0.0, **frame):
        super().__init__(**frame)
        check_range("squares", squares, 1.0, self.side / 2)
        check_range("speed", speed, 0.0, FASTEST)
        self.pitch, self.speed = self.side / squares, speed

    def drawing(self, rng):
        heading = rng.uniform(0, 2 * math.pi)
        x0, y0 = np.array(self.centre) + rng.uniform(-0.5, 0.5, 2) * self.pitch

        def draw(time):
            x = x0 + self.speed * math.cos(heading) * time
            y = y0 + self.speed * math.sin(heading) * time
            across = stripes(self.x[0] - x, self.pitch)
            down = stripes(self.y[:, 0] - y, self.pitch)
            board = 0.5 + 0.5 * down[:, None] * across
            return board, np.ones_like(board), (x, y)

        return draw


class RotatingDot(Target):
    """A dot of radius `size` that circles at `radius`, `speed` turns/s.  Truth: its centre."""

    def __init__(self, *, radius: float = 0.3, size: float = 0.05, speed: float = 0.5, **frame):
        super().__init__(**frame)
        check_range("radius", radius, 0.0, 0.5)
        check_range("size", size, 1 / self.side, 0.5)
        check_range("speed", speed, -FASTEST, FASTEST)
        self.radius, self.size, self.speed = radius * self.side, size * self.side, speed

    def drawing(self, rng):
        start = rng.uniform(0, 2 * math.pi)

        def draw(time):
            x, y = polar(self.centre, self.radius, start + 2 * math.pi * self.speed * time)
            dot = disc(*self.around(x, y), self.size)
            return dot, dot, (x, y)

        return draw


class SpinningStripe(Target):
    """A stripe `length` long and `size` wide, turning about its middle `speed` times a second.

    Truth: one end of it.
    """

    def __init__(self, *, length: float = 0.8, size: float = 0.08, speed: float = 0.5, **frame):
        super().__init__(**frame)
        check_range("length", length, 1 / self.side, 2.0)
        check_range("size", size, 1 / self.side, 1.0)
        check_range("speed", speed, -FASTEST, FASTEST)
        self.length, self.size, self.speed = length * self.side, size * self.side, speed

    def drawing(self, rng):
        start = rng.uniform(0, 2 * math.pi)

        def draw(time):
            angle = start + 2 * math.pi * self.speed * time
            along, across = turned(*self.around(*self.centre), angle)
            shape = inside(self.length / 2 - abs(along)) * inside(self.size / 2 - abs(across))
            return shape, shape, polar(self.centre, self.length / 2, angle)

        return draw


class SpinningDisc(Target):
    """A disc of radius `size` with `sectors` bright sectors between as many dim ones, turning about
    its middle, which stands in the frame's, `speed` times a second.

    Truth: the point of its rim where a bright sector begins.
    """

    def __init__(self, *, size: float = 0.2, sectors: int = 3, speed: float = 0.5, **frame):
        super().__init__(**frame)
        check_range("size", size, 2 / self.side, 0.5)
        check_range("sectors", sectors, 1, 32)
        check_range("speed", speed, -FASTEST, FASTEST)
        self.size, self.sectors, self.speed = size * self.side, int(sectors), speed

    def drawing(self, rng):
        start = rng.uniform(0, 2 * math.pi)

        def draw(time):
            angle = start + 2 * math.pi * self.speed * time
            x, y = self.around(*self.centre)
            cover = disc(x, y, self.size)
            paint = 0.35 + 0.65 * sectors(*turned(x, y, angle), self.sectors)
            return paint * cover, cover, polar(self.centre, self.size, angle)

        return draw


class BouncingBall(Target):
    """A striped ball of radius `size` that falls, bounces to `rise` and comes back `bounces` times
    a second, drifts `speed` frame widths per second from wall to wall and rolls.

    Truth: its centre.
    """

    def __init__(
        self,
        *,
        size: float = 0.12,
        rise: float = 0.6,
        bounces: float = 1.0,
        speed: float = 0.25,
        **frame,
    ):
        super().__init__(**frame)
        check_range("size", size, 2 / self.side, 0.4)
        check_range("rise", rise, 0.0, 1.0 - 2 * size)
        check_range("bounces", bounces, 0.0, FASTEST)
        check_range("speed", speed, 0.0, FASTEST / self.width)
        self.size, self.rise = size * self.side, rise * self.side
        self.bounces, self.speed = bounces, speed * self.width

    def drawing(self, rng):
        place, phase, angle = rng.uniform(0, 2), rng.uniform(0, 1), rng.uniform(0, 2 * math.pi)
        room = self.width - 1 - 2 * self.size
        floor = self.height - 1 - self.size

        def draw(time):
            # The way to and fro is a triangle wave; between bounces the height is a parabola.
            way = (place + self.speed * time / room) % 2
            x = self.size + room * min(way, 2 - way)
            y = floor - self.rise * (1 - (2 * ((phase + self.bounces * time) % 1) - 1) ** 2)
            along, _ = turned(*self.around(x, y), angle + self.speed * time / self.size)
            paint = 0.7 + 0.3 * stripes(along, self.size / 2)
            ball = disc(*self.around(x, y), self.size)
            return paint * ball, ball, (x, y)

        return draw


class Dart(Target):
    """A ringed dart, `length` long and `size` wide, crossing near the middle on a straight line at
    `speed` px/s (the paper's: 16,000 in 12,000 fps), again and again.  Truth: its middle.
    """

    def __init__(self, *, length: float = 0.25, size: float = 0.05, speed: float = 1000.0, **frame):
        super().__init__(**frame)
        check_range("length", length, 2 / self.side, 1.0)
        check_range("size", size, 1 / self.side, length)
        check_range("speed", speed, 0.0, FASTEST)
        self.length, self.size, self.speed = length * self.side, size * self.side, speed

    def drawing(self, rng):
        heading = rng.uniform(0, 2 * math.pi)
        middle = np.array(self.centre) + rng.uniform(-0.2, 0.2, 2) * self.side
        # Half the diagonal and the dart away on either side it is out of sight, where it turns up.
        reach = math.hypot(self.height, self.width) / 2 + 0.3 * self.side + self.length
        start = rng.uniform(0.5, 0.8) * reach

        def draw(time):
            place = (start + self.speed * time) % (2 * reach) - reach
            x, y = polar(middle, place, heading)
            along, across = turned(*self.around(x, y), heading)
            beyond = np.maximum(abs(along) - (self.length - self.size) / 2, 0)
            body = inside(self.size / 2 - np.hypot(beyond, across))
            ring = inside(self.length / 20 - abs(along - self.length / 4))
            return body * (1 - 0.6 * ring), body, (x, y)

        return draw


class DotGrid(Target):
    """`dots` x `dots` discs of radius `size` that stand still.  Truth: the centre of the grid."""

    def __init__(self, *, dots: int = 3, size: float = 0.05, **frame):
        super().__init__(**frame)
        check_range("dots", dots, 1, 64)
        check_range("size", size, 1 / self.side, 0.5 / dots)
        self.dots, self.size = int(dots), size * self.side

    def drawing(self, rng):
        pitch = self.side / self.dots
        places = (np.arange(self.dots) - (self.dots - 1) / 2) * pitch
        x0, y0 = np.array(self.centre) + rng.uniform(-0.5, 0.5, 2)
        picture = sum(disc(*self.around(x0 + x, y0 + y), self.size) for x in places for y in places)
        return lambda time: (picture, picture, (x0, y0))


class Targets:
    """Clip `index` shows kind number `index` modulo their number; `options` holds arguments of one
    kind, `frame` those of all.  Raises ValueError for another kind than those in KINDS.
    """

    def __init__(
        self,
        kinds: Sequence[str],
        *,
        options: Mapping[str, Mapping] | None = None,
        **frame,
    ):
        options = options or {}
        unknown = [name for name in (*kinds, *options) if name not in KINDS]
        if unknown or not kinds:
            raise ValueError(f"scene.kinds must be some of {', '.join(KINDS)}, got {unknown}")
        self.scenes = [KINDS[name](**frame, **options.get(name, {})) for name in kinds]

    def clip(self, index: int) -> Clip:
        """Return clip `index`, cycling over the kinds."""
        turn, kind = divmod(index, len(self.scenes))
        return self.scenes[kind].clip(turn)


KINDS = {
    "checkerboard": Checkerboard,
    "rotating_dot": RotatingDot,
    "spinning_stripe": SpinningStripe,
    "spinning_disc": SpinningDisc,
    "bouncing_ball": BouncingBall,
    "dart": Dart,
    "dot_grid": DotGrid,
}
