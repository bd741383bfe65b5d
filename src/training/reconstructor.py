"""Training, validation and test of any network that turns voxel grids into frames."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from lightning import LightningModule
from torch import Tensor, nn
from torch.nn.utils import parametrize

from src.metrics.scores import Scores
from src.models.unroll import chunks, detach, unroll, video
from src.training.guard import Guard, NotFinite, finite

if TYPE_CHECKING:  # a network knows nothing of the simulation; a sample is read, never made
    from src.sim.pipeline import Sample

PICTURES = 32  # whose losses are computed at a time


class Reconstructor(LightningModule):
    """`network`: see the contract in docs/conventions.md; `target` and `kwargs` of `network_spec`
    say how to build it again and go into the checkpoint.
    `loss` maps (n, 1, h, w) frames and targets in [0, 1] to (n,); `optimizer` makes an optimiser
    from parameters and `scheduler`, if any, a learning-rate schedule from it, one step a batch.
    `detach_every`: windows between two cuts of the graph (truncated back-propagation through time;
    0: none).  Memory is that of one chunk; the optimiser steps once per batch.
    `spike`: a loss so many times the median of the last hundred moves the weights no more than that
    median would (Guard); None: off.
    `scores` measures frames against targets; the first `warmup` windows of a clip are not scored.
    """

    def __init__(
        self,
        network: nn.Module,
        network_spec: dict,
        *,
        loss: Callable[[Tensor, Tensor], Tensor] | None = None,
        optimizer: Callable | None = None,
        scheduler: Callable | None = None,
        scores: Scores | None = None,
        detach_every: int = 0,
        warmup: int = 0,
        spike: float | None = None,
    ):
        super().__init__()
        if detach_every < 0:
            raise ValueError(f"data.detach_every must be >= 0, got {detach_every}")
        self.automatic_optimization = False
        self.network, self.network_spec = network, network_spec
        self.optimizer, self.scheduler = optimizer, scheduler
        self.detach_every, self.warmup, self.guard = detach_every, warmup, Guard(spike)
        # In a tuple, so that their backbones stay out of the parameters and the checkpoint.
        self._measures = (loss, scores)
        self.clips: list[dict] = []

    @property
    def loss(self) -> Callable[[Tensor, Tensor], Tensor]:
        """The training loss."""
        return self._measures[0]

    @property
    def scores(self) -> Scores:
        """What is measured in validation and test."""
        return self._measures[1]

    @property
    def method(self) -> nn.Module:
        """What is validated and tested."""
        return self.network

    def on_fit_start(self) -> None:
        """Move the loss, which is no submodule, to the training device; undo a test's eval mode."""
        self.loss.to(self.device)
        self.train()

    def training_step(self, sample: "Sample", batch_idx: int) -> Tensor:
        """One optimiser step on a batch of sequences; returns the loss averaged over windows (and
        over processes: all of them decide alike).

        Raises NotFinite, with the clips, for a loss or gradient that is not; no step is taken then.
        """
        windows = sample.voxels.shape[1]
        state, total = None, torch.zeros((), device=self.device)
        self.optimizers().zero_grad()
        for part in chunks(windows, self.detach_every):
            # One normalised weight per chunk: spectral norm iterates once, not once per window.
            with parametrize.cached():
                frames, state = self._unroll(sample, part, detach(state))
            total += self._backward(frames, sample.target[:, part], windows * len(sample.voxels))
        total = self.all_gather(total).mean()
        self._protect(total, sample.drawn)
        self.optimizers().step()
        if self.scheduler is not None:
            self.lr_schedulers().step()
        self.log("train/loss", total, prog_bar=True, batch_size=len(sample.voxels))
        return total

    def _backward(self, frames: Tensor, target: Tensor, count: int) -> Tensor:
        """Back-propagate the sum of the losses over `count`; return it.

        The loss sees every picture alone, so its gradient there is had a few pictures at a time,
        and its own maps (VGG's are larger than the network's) never stand in memory together.
        """
        pictures = frames.flatten(0, 1)
        leaves, total = pictures.detach().requires_grad_(), torch.zeros((), device=self.device)
        pairs = zip(leaves.split(PICTURES), target.flatten(0, 1).split(PICTURES), strict=True)
        for ours, truth in pairs:
            loss = self.loss(ours, truth).sum() / count
            loss.backward()
            total += loss.detach()
        self.manual_backward(pictures, leaves.grad)
        return total

    def _protect(self, loss: Tensor, drawn: list[dict]) -> None:
        """Stop what is not finite, scale down what leaps."""
        gradients = [parameter.grad for parameter in self.network.parameters()]
        if not torch.isfinite(loss):
            raise NotFinite(f"loss is {float(loss)}", self.global_step, drawn)
        if not finite(gradients):
            raise NotFinite("a gradient is not finite", self.global_step, drawn)
        share = self.guard.share(float(loss))
        if share < 1:
            torch._foreach_mul_([gradient for gradient in gradients if gradient is not None], share)

    def validation_step(self, sample: "Sample", batch_idx: int) -> None:
        """Log the mean of every score over the validation clips."""
        for clip in self._measure(sample):
            values = {f"val/{name}": clip[name] for name in self.scores.names}
            self.log_dict(values, on_epoch=True, prog_bar=False, batch_size=1)

    def on_test_start(self) -> None:
        """Forget the clips of an earlier test."""
        self.clips = []

    def test_step(self, sample: "Sample", batch_idx: int) -> None:
        """Append the scores of each clip, with what was drawn for it, to `clips`."""
        self.sample = sample
        self.clips += self._measure(sample)

    def _measure(self, sample: "Sample") -> list[dict]:
        with parametrize.cached():
            frames = video(self.method, sample)
        frames, target = frames[:, self.warmup :], sample.target[:, self.warmup :]
        clips = zip(frames, target, sample.drawn, strict=True)
        return [drawn | self.scores(ours, truth) for ours, truth, drawn in clips]

    def _unroll(self, sample: "Sample", part: slice, state: Any):
        known = {"window_s": sample.window_s, "positions": sample.positions}
        return unroll(self.network, sample.voxels[:, part], state, **known)

    def configure_optimizers(self):
        """Return the optimiser over all parameters and its schedule."""
        optimizer = self.optimizer(self.network.parameters())
        if self.scheduler is None:
            return optimizer
        return [optimizer], [self.scheduler(optimizer)]

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        """Add how to build the network again (plain data: loads with weights_only=True)."""
        checkpoint["network"] = self.network_spec
        checkpoint["losses"] = list(self.guard.losses)

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        """Remember the losses that the guard had seen."""
        self.guard.losses.extend(checkpoint.get("losses", ()))
