"""The scores of videos as torchmetrics, whose means over clips and processes are theirs."""

import math
from collections.abc import Callable, Mapping
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional
from torchmetrics import MeanMetric, Metric, MetricCollection

from src.metrics.image import aligned_psnr, psnr, ssim
from src.metrics.lpips import LPIPS
from src.metrics.table import NAMES, Column
from src.metrics.temporal import Video, find_textured_pairs, temporal_jitter_px

LEAST_CONTRAST = 0.05  # grey levels: at mid-grey the lowest contrast threshold in use, 0.1


def score_aligned_psnr(frames: Video, target: Video) -> Float[Tensor, " scored"]:
    """Return the aligned PSNR in dB of the frames whose target has contrast: any frame equals one
    without."""
    kept = _have_contrast(target)
    return aligned_psnr(frames[kept], target[kept])


SCORES = {  # name in table.py: a value per frame
    "psnr": psnr,
    "psnr_aligned": score_aligned_psnr,
    "ssim": ssim,
}


class ClipMean(MeanMetric):
    """The mean over clips of the mean of `score(frames, target)` over a clip; clips of which it
    returns no value are left out."""

    full_state_update = False

    def __init__(self, score: Callable[[Tensor, Tensor], Tensor]):
        super().__init__(nan_strategy="disable")
        # In a tuple: the parameters of a network that scores are no part of a checkpoint.
        self._score = (score,)
        self.is_clip_scored = False  # the last one

    def update(self, frames: Video, target: Video) -> None:  # type: ignore[override]
        (score,) = self._score
        if isinstance(score, LPIPS):
            score.to(frames.device)
        values = score(frames, target)
        self.is_clip_scored = values.numel() > 0
        if self.is_clip_scored:
            super().update(values.mean())


def resample(frames: Video, scale: float) -> Float[Tensor, "frames 1 h2 w2"]:
    """Return frames of `scale` times the resolution: pixels repeated, below 1 areas averaged."""
    if scale == 1:
        return frames
    size = [math.floor(side * scale + 0.5) for side in frames.shape[-2:]]
    return functional.interpolate(frames, size, mode="nearest" if scale > 1 else "area")


def measure_reduced_jitter_px(
    frames: Video, target: Video, reduction: int
) -> Float[Tensor, " pairs"]:
    """Return the temporal jitter of pairs of frames in their pixels, measured on frames `reduction`
    times smaller; of the pairs whose targets have contrast and a block with texture in both."""
    smaller = [resample(video, 1 / reduction) for video in (frames, target)]
    seen = _have_contrast(target)
    kept = seen[1:] & seen[:-1] & find_textured_pairs(smaller[1])
    return reduction * temporal_jitter_px(*smaller)[kept]


def _have_contrast(target: Video) -> Bool[Tensor, " frames"]:
    """Return which frames have a range of LEAST_CONTRAST or more."""
    values = target.flatten(1)
    return values.amax(1) - values.amin(1) >= LEAST_CONTRAST


def score_by_user_metric(name: str, metric: Metric, frames: Tensor, target: Tensor) -> Tensor:
    """Return the value that a torchmetrics metric, `metrics.<name>` of the config, has on one clip.

    Its `update` is given frames and target, (frames, 1, h, w) in [0, 1]; `compute` gives one number
    or one per frame.  Raises ValueError for something else.
    """
    value = metric.to(frames.device)(frames, target)
    metric.reset()
    if not isinstance(value, Tensor) or not value.numel() or value.is_complex():
        got = f"{type(value).__name__} {value}"[:60]
        raise ValueError(f"metrics.{name} must compute a tensor of numbers, got {got}")
    return value.float()


class VideoMetrics(MetricCollection):
    """PSNR, aligned PSNR, SSIM, temporal jitter and, if a network is given, LPIPS of clips; and
    those of `own`, by name, each as score_by_user_metric.  Aligned PSNR and jitter leave out frames
    whose target has a range (max - min) below 0.05, jitter pairs of frames without a textured
    block, too; a clip that has no others has no such score.

    Frames are clipped to [0, 1], with NaN for what is not finite; the data range is 1.
    `resolution_scale`: frames and targets are scored at so many times their own resolution,
    temporal jitter in pixels of the scored frame.  Whole numbers repeat pixels, so that PSNR stays,
    and multiply jitter; below 1 areas are averaged.  `jitter_reduction`: frames are made so many
    times smaller before jitter is measured, so that its blocks show as much of a larger frame.
    Raises ValueError for another, and for a name in `own` that is taken.
    """

    def __init__(
        self, lpips: LPIPS | None = None, resolution_scale: float = 1.0,
        own: Mapping[str, Metric] | None = None, jitter_reduction: int = 1,
    ):  # fmt: skip
        scale = resolution_scale
        if not (type(jitter_reduction) is int and 1 <= jitter_reduction <= 8):
            allowed = "one of 1..8"
            raise ValueError(f"metrics.jitter_reduction must be {allowed}, got {jitter_reduction}")
        if not 0 < scale <= 8 or (scale > 1 and scale != int(scale)):
            raise ValueError(
                f"metrics.resolution_scale must be in (0, 1] or one of 2..8, got {scale}"
            )
        own = own or {}
        if taken := [name for name in own if name in NAMES or hasattr(MetricCollection, name)]:
            raise ValueError(f"metrics.{taken[0]} must be called otherwise: the name is taken")
        scores = SCORES if lpips is None else SCORES | {"lpips": lpips}
        scores = scores | {k: partial(score_by_user_metric, k, m) for k, m in own.items()}
        reduction = jitter_reduction * max(1, int(scale))  # repeated pixels show nothing more
        scores["temporal_jitter_px"] = partial(measure_reduced_jitter_px, reduction=reduction)
        metrics: dict[str, Metric | MetricCollection]
        metrics = {name: ClipMean(score) for name, score in scores.items()}
        # Groups would merge scores that are equal on the first clip.
        super().__init__(metrics, compute_groups=False)
        self.resolution_scale = scale
        self.names = (*(name for name in NAMES if name in scores), *own)
        self.user_metric_columns: tuple[Column, ...] = tuple(
            Column(name, name, 3, {None: 0, True: 1, False: -1}[metric.higher_is_better])
            for name, metric in own.items()
        )

    @torch.no_grad()
    def forward(self, frames: Video, target: Video) -> dict[str, float | None]:
        """Add a clip; return its scores by name, None for one that it does not have."""
        pair = (frames.float().clamp(0, 1).where(frames.isfinite(), torch.nan), target)
        values = super().forward(*(resample(video, self.resolution_scale) for video in pair))
        return {k: float(v) if self._is_clip_scored(k) else None for k, v in values.items()}

    def _is_clip_scored(self, name: str) -> bool:
        mean = self[name]
        assert isinstance(mean, ClipMean)
        return mean.is_clip_scored
