"""Limits of the gradients of a step, so that one bad batch does not ruin a training."""

import math
from collections import deque
from collections.abc import Sequence
from statistics import median

import torch
from torch import Tensor


class NonFiniteError(ValueError):
    """A loss or gradient is NaN or infinite; `clips` are the numbers of the batch's clips, of
    `data.large` if `is_large`."""

    def __init__(self, what: str, step: int, drawn: list[dict]):
        self.clips = [clip.get("clip") for clip in drawn]
        self.is_large = any(clip.get("large") for clip in drawn)
        stream = " of data.large" if self.is_large else ""
        super().__init__(f"{what} at step {step}, clips {self.clips}{stream}: {drawn}")


class StepGuard:
    """Scales the gradients of a step down.

    `loss_spike_factor`: a loss more than so many times the median of the last 100 losses moves the
    weights no more than that median would, after the first `min_losses` losses; it is remembered
    as so many times the median, which a lasting change moves so.  None: off.
    `grad_clip_norm`: largest Euclidean norm over all gradients; None: any.  Raises ValueError for a
    factor <= 1 or a norm <= 0.
    """

    def __init__(
        self,
        loss_spike_factor: float | None = None,
        grad_clip_norm: float | None = None,
        min_losses: int = 20,
    ):
        if loss_spike_factor is not None and not loss_spike_factor > 1:
            raise ValueError(f"loss_spike_factor must be > 1 or null, got {loss_spike_factor}")
        if grad_clip_norm is not None and not grad_clip_norm > 0:
            raise ValueError(f"grad_clip_norm must be > 0 or null, got {grad_clip_norm}")
        self.loss_spike_factor, self.grad_clip_norm = loss_spike_factor, grad_clip_norm
        self.min_losses = min_losses
        self.losses: deque[float] = deque(maxlen=100)

    def scale_gradients(
        self, gradients: Sequence[Tensor], loss: Tensor, step: int, drawn: list[dict]
    ) -> None:
        """Scale `gradients` in place.  Raises NonFiniteError, naming the clips `drawn`, before."""
        if not torch.isfinite(loss):
            raise NonFiniteError(f"loss is {float(loss)}", step, drawn)
        norm = torch.nn.utils.get_total_norm(gradients)
        if not torch.isfinite(norm):
            raise NonFiniteError("a gradient is not finite", step, drawn)
        factor = self.gradient_scale(float(loss))
        if self.grad_clip_norm is not None:
            factor *= min(1.0, self.grad_clip_norm / max(factor * float(norm), 1e-12))
        if factor < 1:
            torch._foreach_mul_(list(gradients), factor)

    def gradient_scale(self, loss: float) -> float:
        """Return the factor, in (0, 1], for the gradients of a step of this loss; remember it."""
        usual = median(self.losses) if len(self.losses) >= self.min_losses else math.inf
        most = math.inf if self.loss_spike_factor is None else self.loss_spike_factor * usual
        self.losses.append(min(loss, most))
        return usual / loss if loss > most else 1.0
