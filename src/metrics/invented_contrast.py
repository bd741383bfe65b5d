"""Invented contrast: what a network draws where a static camera saw nothing."""

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy import ndimage

REACH_PX = 12.0  # from an event, beyond which it tells nothing of the brightness


def find_unseen_pixels(has_events: Shaped[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels farther than REACH_PX from each that had an event; all, if none had."""
    has_events = np.asarray(has_events, bool)
    if not has_events.any():
        return np.ones_like(has_events)
    return ndimage.distance_transform_edt(~has_events) > REACH_PX


def invented_contrast(frame: Float[np.ndarray, "h w"], unseen: Shaped[np.ndarray, "h w"]) -> float:
    """Return the standard deviation of `frame` where `unseen`, over its contrast (99th less 1st
    percentile) elsewhere: 0 for a background of one value.

    NaN where either part is empty or the contrast is 0.
    """
    unseen = np.asarray(unseen, bool)
    if not unseen.any() or unseen.all():
        return float("nan")
    low, high = np.quantile(frame[~unseen], (0.01, 0.99))
    return float(frame[unseen].std() / (high - low)) if high > low else float("nan")
