"""Event rates of a recording: events per sensor pixel per second, per view, ON and OFF apart.

Pixels are those of the sensor, not of the warped view: a homography changes the rate per pixel by
its ratio of areas.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import median_filter

from src.sim import noise

HOT = 5.0  # times its neighbours' median plus its view's mean: more than texture makes
FEW = 10  # events beyond that, so that a pixel is not hot by chance


@dataclass(frozen=True)
class Rates:
    """`events` (slices, views, 2) ON and OFF in slices of `slice_s`; `pixels` of each view that
    count, `hot` ones left out."""

    events: Int[np.ndarray, "slices views 2"]
    pixels: Int[np.ndarray, " views"]
    hot: Int[np.ndarray, " views"]
    slice_s: float

    @property
    def per_view(self) -> Float[np.ndarray, "views 2"]:
        """Return the rate of each view in events / pixel / s, ON and OFF."""
        seconds = len(self.events) * self.slice_s
        return self.events.sum(0) / (self.pixels[:, None] * seconds)

    @property
    def pooled(self) -> Float[np.ndarray, " 2"]:
        """Return the rate over all views."""
        return self.events.sum((0, 1)) / (self.pixels.sum() * len(self.events) * self.slice_s)

    def bootstrap(self, draws: int = 1000, seed: int = 0) -> Float[np.ndarray, "draws 2"]:
        """Return pooled rates of recordings put together from this one's blocks of slices.

        Blocks of n ** (1/3) successive slices, wrapping around, keep what one slice tells of the
        next (circular block bootstrap, Politis and Romano 1992).
        """
        n = len(self.events)
        length = max(1, round(n ** (1 / 3)))
        blocks = -(-n // length)
        drawn = noise.bits(noise.key(seed, "bootstrap"), torch.arange(draws * blocks)).numpy()
        first = (drawn % n).reshape(draws, blocks, 1)
        slices = ((first + np.arange(length)) % n).reshape(draws, -1)[:, :n]
        events = self.events.sum(1)[slices].sum(1)
        return events / (self.pixels.sum() * n * self.slice_s)


def measure(
    recording: Iterable[np.ndarray], view: Int[np.ndarray, "h w"], *, slices: int = 100
) -> Rates:
    """Return the rates of a recording; it is gone through twice, in its pieces.

    `recording` yields structured arrays t (us), x, y, p in order of time, again each time it is
    iterated; `view` holds the view of each sensor pixel, -1 for none; the time from the first to
    the last event is cut into `slices`.  Raises ValueError without two instants or without views.
    """
    totals, start, end = _totals(recording, view.shape)
    if end <= start:
        raise ValueError("event rates need a recording of more than one instant")
    if view.max() < 0:
        raise ValueError("event rates need at least one view on the sensor")
    hot = hot_pixels(totals, view)
    seen = np.where(hot, -1, view)
    views, span = int(view.max()) + 1, end - start + 1
    events = np.zeros((slices, views, 2), np.int64)
    for piece in recording:
        owner = seen[piece["y"], piece["x"]].astype(np.int64)
        part = (piece["t"] - start) * slices // span
        place = ((part * views + owner) * 2 + (piece["p"] < 0))[owner >= 0]
        events += np.bincount(place, minlength=events.size).reshape(events.shape)
    pixels, lost = (np.bincount(view[mask & (view >= 0)], minlength=views) for mask in (~hot, hot))
    return Rates(events, pixels, lost, span * 1e-6 / slices)


def hot_pixels(totals: Int[np.ndarray, "h w"], view: Int[np.ndarray, "h w"]) -> np.ndarray:
    """Return where a pixel fires over 5 times as often as its neighbours and its view together."""
    mean = np.zeros(totals.shape)
    for index in range(int(view.max()) + 1):
        mean[view == index] = totals[view == index].mean() if (view == index).any() else 0.0
    return (view >= 0) & (totals > HOT * (median_filter(totals, 3) + mean) + FEW)


def _totals(recording, shape: tuple[int, int]) -> tuple[np.ndarray, int, int]:
    """Return events per pixel, and the times of the first and the last."""
    totals, start, end = np.zeros(shape, np.int64), None, 0
    for piece in recording:
        if piece["x"].max() >= shape[1] or piece["y"].max() >= shape[0]:
            raise ValueError(
                f"events lie outside the {shape[1]}x{shape[0]} sensor of the views: up to "
                f"{piece['x'].max()}, {piece['y'].max()}"
            )
        start = int(piece["t"][0]) if start is None else start
        end = int(piece["t"][-1])
        place = piece["y"].astype(np.int64) * shape[1] + piece["x"]
        totals += np.bincount(place, minlength=totals.size).reshape(shape)
    return totals, start or 0, end
