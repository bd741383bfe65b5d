"""The scores of videos as torchmetrics, whose means over clips and processes are theirs."""

import math
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional
from torchmetrics import MeanMetric, Metric, MetricCollection

from src.metrics.image import aligned_psnr, psnr, ssim
from src.metrics.lpips import LPIPS
from src.metrics.table import NAMES, Column
from src.metrics.temporal import Video, temporal_jitter_px

SCORES = {  # name in table.py: a value per frame, or per step from a frame to the next
    "psnr": psnr,
    "psnr_aligned": aligned_psnr,
    "ssim": ssim,
    "temporal_jitter_px": temporal_jitter_px,
}


class ClipMean(MeanMetric):
    """The mean over clips of the mean of `score(frames, target)` over a clip."""

    full_state_update = False

    def __init__(self, score: Callable[[Tensor, Tensor], Tensor]):
        super().__init__(nan_strategy="disable")
        # In a tuple: the parameters of a network that scores are no part of a checkpoint.
        self._score = (score,)

    def update(self, frames: Video, target: Video) -> None:  # type: ignore[override]
        (score,) = self._score
        if isinstance(score, LPIPS):
            score.to(frames.device)
        super().update(score(frames, target).mean())


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
    those of `own`, by name, each as score_by_user_metric.

    Frames are clipped to [0, 1]; the data range is 1.  `resolution_scale`: frames and targets are
    scored at so many times their own resolution, temporal jitter in pixels of the scored frame.
    Whole numbers repeat pixels, so that PSNR stays; below 1 areas are averaged.  Raises ValueError
    for another, and for a name in `own` that is taken.
    """

    def __init__(
        self, lpips: LPIPS | None = None, resolution_scale: float = 1.0,
        own: Mapping[str, Metric] | None = None,
    ):  # fmt: skip
        scale = resolution_scale
        if not 0 < scale <= 8 or (scale > 1 and scale != int(scale)):
            raise ValueError(
                f"metrics.resolution_scale must be in (0, 1] or one of 2..8, got {scale}"
            )
        own = own or {}
        if taken := [name for name in own if name in NAMES or hasattr(MetricCollection, name)]:
            raise ValueError(f"metrics.{taken[0]} must be called otherwise: the name is taken")
        scores = SCORES if lpips is None else SCORES | {"lpips": lpips}
        scores = scores | {k: partial(score_by_user_metric, k, m) for k, m in own.items()}
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
    def forward(self, frames: Video, target: Video) -> dict[str, float]:
        """Add a clip; return its scores by name."""
        frames = self._resample(frames.float().clamp(0, 1))
        values = super().forward(frames, self._resample(target))
        return {name: float(value) for name, value in values.items()}

    def _resample(self, frames: Tensor) -> Tensor:
        if self.resolution_scale == 1:
            return frames
        size = [math.floor(side * self.resolution_scale + 0.5) for side in frames.shape[-2:]]
        mode = "nearest" if self.resolution_scale > 1 else "area"
        return functional.interpolate(frames, size, mode=mode)
