"""Scores of a frame as EVREAL has them (Ercan et al. 2023): MSE, SSIM and LPIPS, after what its
configs may ask for: the output stretched, the histograms of both pictures equalised.
"""

import math
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from skimage import exposure
from skimage.filters import rank
from skimage.morphology import disk
from skimage.util import img_as_float32, img_as_ubyte

from src.metrics.image import ssim
from src.metrics.lpips import LPIPS

PERCENTILES = {"none": None, "robust": (1, 99), "standard": (0, 100), "exprobust": (1, 99)}
EQUALISATIONS = ("none", "global", "local", "clahe")
LOCAL_RADIUS_PX = 55
Picture = Float[np.ndarray, "h w"]


def normalise_output(picture: Picture, kind: str) -> Picture:
    """Return a frame between two of its percentiles: 1 and 99 (robust; exprobust of its
    exponential) or 0 and 100 (standard); as it is for none.  Without contrast it is nan."""
    percentiles = PERCENTILES[kind]
    if percentiles is None:
        return picture
    picture = np.exp(picture) if kind == "exprobust" else picture
    low, high = np.percentile(picture, percentiles)
    with np.errstate(invalid="ignore", divide="ignore"):
        return ((picture - low) / (high - low)).astype(np.float32)


def equalise_histogram(picture: Picture, kind: str) -> Picture:
    """Return a picture in [0, 1] after equalisation: global, local (a disk of 55 pixels), clahe
    (2.0, 8x8 tiles), or none."""
    if kind == "global":
        return img_as_float32(exposure.equalize_hist(picture))
    if kind == "local":
        return img_as_float32(rank.equalize(img_as_ubyte(picture), disk(LOCAL_RADIUS_PX)))
    if kind == "clahe":
        clahe = cv2.createCLAHE(clipLimit=2.0, tileGridSize=(8, 8))
        return img_as_float32(clahe.apply(img_as_ubyte(picture)))
    return picture


def score_frame(
    picture: Picture, truth: Picture, histogram: str, lpips: LPIPS | None, device: Any
) -> dict[str, float]:
    """Return mse, ssim and, with its network, lpips; nan for a frame without contrast."""
    if not np.isfinite(picture).all():
        return dict.fromkeys(("mse", "ssim", *(["lpips"] if lpips else [])), math.nan)
    ours, theirs = (equalise_histogram(part, histogram) for part in (picture, truth))
    scores = {"mse": float(np.mean(np.square(ours - theirs, dtype=np.float64)))}
    pair = [torch.from_numpy(np.ascontiguousarray(part))[None, None] for part in (ours, theirs)]
    scores["ssim"] = float(ssim(*pair))
    if lpips is not None:
        scores["lpips"] = float(lpips(*(part.to(device) for part in pair)))
    return scores
