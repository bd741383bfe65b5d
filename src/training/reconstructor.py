"""Training, validation and test of any network that turns voxel grids into frames."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from lightning import LightningModule
from torch import Tensor, nn
from torch.nn.utils import parametrize

from src.metrics.scores import Scores
from src.models.unroll import chunks, detach, takes, unroll, video, within
from src.training.average import copy_of, follow
from src.training.clock import Clock
from src.training.graphed import GraphedUnroll
from src.training.guard import Guard, NotFinite
from src.training.steadiness import flicker, unrest
from src.training.step_time import StageClock

if TYPE_CHECKING:  # a network knows nothing of the simulation; a sample is read, never made
    from src.sim.pipeline import Sample

PICTURES = {"cpu": 32, "cuda": 256}  # whose losses are computed at a time
SETS = 4  # of windows that the loss sees, where each has a CUDA graph


class Reconstructor(LightningModule):
    """`network`: see the contract in docs/conventions.md; `target` and `kwargs` of `network_spec`
    say how to build it again and go into the checkpoint.
    `loss` maps (n, 1, h, w) frames and targets in [0, 1] to (n,); `optimizer` makes an optimiser
    from parameters and `scheduler`, if any, a learning-rate schedule from it, one step a batch.
    `detach_every`: windows between two cuts of the graph (truncated back-propagation through time;
    0: none).  Memory is that of one chunk; the optimiser steps once per batch.
    `loss_from`: the first window of a sequence that the loss sees; those before fill the state.
    `loss_pairs`: of the windows from there on the loss sees so many pairs of neighbours, one in
    each equal part, drawn anew in every step (None: all windows): what is alike is not paid for.
    `steady`: weight of the mean change of a picture's error from one window to the next: a picture
    may be wrong, but not flicker.
    `calm`: weight of a picture's own change, over its contrast, where the truth stands still.
    `teach`: weight, where there are teachers, of the loss against what they make of a clip; where
    it has `anchors`, of these alone, so that what LPIPS sees is the truth.
    `clip`: longest gradient (Euclidean norm over all parameters; None: as long as it is).
    `average`: decay of the weights' running mean, which then is what is validated, tested and
    shipped (average.py); None: none.  `clock` counts the time of training.
    `spike`: a loss so many times the median of the last hundred moves the weights no more than that
    median would (Guard); None: off.
    `graphs`: on a GPU a sequence is unrolled as CUDA graphs (graphed.py), and `loss_pairs` are out
    of SETS sets only, a graph for each.
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
        loss_from: int = 0,
        loss_pairs: int | None = None,
        steady: float = 0.0,
        calm: float = 0.0,
        teach: float = 1.0,
        clip: float | None = None,
        average: float | None = None,
        clock: Clock | None = None,
        graphs: bool = False,
    ):
        super().__init__()
        if detach_every < 0:
            raise ValueError(f"data.detach_every must be >= 0, got {detach_every}")
        for name, weight in (("steady", steady), ("calm", calm), ("teach", teach)):
            if not 0 <= weight < math.inf:
                raise ValueError(f"{name} must be >= 0, got {weight}")
        if clip is not None and not clip > 0:
            raise ValueError(f"clip must be > 0 or null, got {clip}")
        if average is not None and not 0 <= average < 1:
            raise ValueError(f"average must be in [0, 1) or null, got {average}")
        self.automatic_optimization = False
        self.network, self.network_spec = network, network_spec
        # In a tuple: no step trains it, and it has its own place in the checkpoint.
        self._mean, self.decay = (None if average is None else copy_of(network),), average
        self.optimizer, self.scheduler = optimizer, scheduler
        self.detach_every, self.warmup, self.guard = detach_every, warmup, Guard(spike)
        self.loss_from, self.loss_pairs = loss_from, loss_pairs
        self.steady, self.calm, self.teach, self.clip = steady, calm, teach, clip
        self.clock, self.stages = clock or Clock(), StageClock()
        self.graphs = GraphedUnroll(network) if graphs and not detach_every else None
        self.windows_seen, self.steps_before, self.rates = 0, 0, []
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
        return self.network if self.average is None else self.average

    @property
    def average(self) -> nn.Module | None:
        """The running mean of the weights."""
        return self._mean[0]

    @property
    def steps(self) -> int:
        """Steps so far, also those of a training whose exported weights this goes on from."""
        return self.steps_before + self.global_step

    def on_fit_start(self) -> None:
        """Move what is no submodule to the training device; undo a test's eval mode."""
        for part in (self.loss, self.average):
            if part is not None:
                part.to(self.device)
        self.train()

    def on_train_start(self) -> None:
        """Count time from here."""
        self.clock.start()

    def on_validation_end(self) -> None:
        """Leave the time of validation out."""
        self.clock.start()

    def training_step(self, sample: "Sample", batch_idx: int) -> Tensor:
        """One optimiser step on a batch of sequences; returns the loss averaged over windows (and
        over processes: all of them decide alike).

        Raises NotFinite, with the clips, for a loss or gradient that is not; no step is taken then.
        """
        windows = sample.voxels.shape[1]
        chosen = self._chosen(windows)
        self.stages.start()
        state, total = None, torch.zeros((), device=self.device)
        self.optimizers().zero_grad()
        for part in chunks(windows, self.detach_every):
            shown = within(chosen, part)  # of the others nothing is learned but to fill the state
            frames, state = self._forward(sample, part, state, shown)
            self.stages.mark("forward")
            if shown:
                share = len(shown) / len(chosen)
                total += self._backward(frames, self._goals(sample, part, shown), shown, share)
        total = self.all_gather(total).mean()
        self._protect(total, sample.drawn)
        self._step()
        self.stages.mark("optimiser")
        self.windows_seen += windows * len(sample.voxels) * self.trainer.world_size
        self.log("train/loss", total, prog_bar=True, batch_size=len(sample.voxels))
        self.clock.lap()
        return total

    def _forward(
        self, sample: "Sample", part: slice, state: Any, shown: list[int]
    ) -> tuple[Tensor, Any]:
        """Return the frames of the windows `shown` of a `part`, and the state after it."""
        if self.graphs is not None and sample.voxels.is_cuda:
            return self.graphs(sample.voxels, sample.window_s, sample.positions, shown), None
        # One normalised weight per chunk: spectral norm iterates once, not once per window.
        with parametrize.cached(), torch.set_grad_enabled(bool(shown)):
            return self.unrolled(sample, part, detach(state), shown or [0])

    def _chosen(self, windows: int) -> list[int]:
        """Return the windows that the loss sees, ascending."""
        if self.loss_pairs is None:
            return list(range(self.loss_from, windows))
        drawn = self.global_step if self.graphs is None else self.global_step % SETS
        drawer = torch.Generator().manual_seed(drawn)
        ends = [
            self.loss_from + part * (windows - self.loss_from) // self.loss_pairs
            for part in range(self.loss_pairs + 1)
        ]
        firsts = [int(torch.randint(a, b - 1, (), generator=drawer)) for a, b in pairwise(ends)]
        return [first + one for first in firsts for one in (0, 1)]

    def _goals(
        self, sample: "Sample", part: slice, shown: list[int]
    ) -> list[tuple[Tensor, Callable[[Tensor, Tensor], Tensor]]]:
        """Return what the pictures `shown` of `part` should be, and the loss against each: the
        truth, then what is taught.
        """
        loss, teach = self.loss, self.teach
        if takes(loss, "drawer"):  # a loss that draws, draws the same again in a resumed run
            loss = partial(loss, drawer=torch.Generator().manual_seed(self.global_step))
        goals = [(sample.target[:, part][:, shown], loss)]
        if sample.taught is not None:
            anchors = getattr(self.loss, "anchors", self.loss)
            taught = sample.taught[:, part][:, shown]
            goals.append((taught, lambda ours, theirs: teach * anchors(ours, theirs)))
        return goals

    def _step(self) -> None:
        self.optimizers().step()
        if self.scheduler is not None:
            self.lr_schedulers().step()
        if self.average is not None:
            follow(self.average, self.network, self.decay, self.global_step)

    def _backward(
        self,
        frames: Tensor,
        goals: list[tuple[Tensor, Callable[[Tensor, Tensor], Tensor]]],
        shown: list[int],
        share: float,
    ) -> Tensor:
        """Back-propagate `share` of the mean loss of the windows `shown`; return it.

        The loss sees every picture alone, so its gradient there is had a few pictures at a time,
        and its own maps (VGG's are larger than the network's) never stand in memory together.
        What holds pictures steady, against the first of `goals`, is added to it.
        """
        pictures = frames.flatten(0, 1)
        leaves, total = pictures.detach().requires_grad_(), torch.zeros((), device=self.device)
        count = PICTURES["cuda" if pictures.is_cuda else "cpu"]
        for goal, loss in goals:
            pairs = zip(leaves.split(count), goal.flatten(0, 1).split(count), strict=True)
            for ours, truth in pairs:
                part = loss(ours, truth).sum() * (share / len(pictures))
                part.backward()
                total += part.detach()
        follows = torch.tensor([b == a + 1 for a, b in pairwise(shown)])
        asked = [(w, of) for w, of in ((self.steady, flicker), (self.calm, unrest)) if w]
        if asked and follows.any():
            seen = leaves.unflatten(0, frames.shape[:2]), goals[0][0], follows
            change = share * sum(weight * of(*seen) for weight, of in asked)
            change.backward()
            total += change.detach()
        self.stages.mark("loss")
        self.manual_backward(pictures, leaves.grad)
        self.stages.mark("backward")
        return total

    def _protect(self, loss: Tensor, drawn: list[dict]) -> None:
        """Stop what is not finite, scale down what leaps or is too long."""
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        if not torch.isfinite(loss):
            raise NotFinite(f"loss is {float(loss)}", self.global_step, drawn)
        norm = torch.nn.utils.get_total_norm(gradients)
        if not torch.isfinite(norm):
            raise NotFinite("a gradient is not finite", self.global_step, drawn)
        share = self.guard.share(float(loss))
        if self.clip is not None:
            share *= min(1.0, self.clip / max(share * float(norm), 1e-12))
        if share < 1:
            torch._foreach_mul_(gradients, share)

    def validation_step(self, sample: "Sample", batch_idx: int) -> None:
        """Log the mean of every score over the validation clips."""
        for clip in self.measure(sample):
            values = {f"val/{name}": clip[name] for name in self.scores.names}
            self.log_dict(values, on_epoch=True, prog_bar=False, batch_size=1)

    def on_test_start(self) -> None:
        """Forget the clips of an earlier test."""
        self.clips = []

    def test_step(self, sample: "Sample", batch_idx: int) -> None:
        """Append the scores of each clip, with what was drawn for it, to `clips`."""
        self.sample = sample
        self.clips += self.measure(sample)

    def measure(self, sample: "Sample") -> list[dict]:
        """Return the scores of each clip with what was drawn for it."""
        with parametrize.cached():
            frames = video(self.method, sample)
        frames, target = frames[:, self.warmup :], sample.target[:, self.warmup :]
        clips = zip(frames, target, sample.drawn, strict=True)
        return [drawn | self.scores(ours, truth) for ours, truth, drawn in clips]

    def unrolled(
        self,
        sample: "Sample",
        part: slice,
        state: Any = None,
        shown: Sequence[int] | None = None,
    ) -> tuple[Tensor, Any]:
        """Return what the network in training makes of a `part` of the windows, of those `shown`
        (None: all), counted from its first, and its state after all of them.
        """
        options = {"window_s": sample.window_s, "positions": sample.positions, "shown": shown}
        return unroll(self.network, sample.voxels[:, part], state, **options)

    def configure_optimizers(self):
        """Return the optimiser over all parameters and its schedule."""
        optimizer = self.optimizer(self.network.parameters())
        # Before a checkpoint's are restored, which a schedule has changed.
        self.rates = [group["lr"] for group in optimizer.param_groups]
        if self.scheduler is None:
            return optimizer
        return [optimizer], [self.scheduler(optimizer)]

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        """Add how to build the network again (plain data: loads with weights_only=True)."""
        checkpoint["network"] = self.network_spec
        checkpoint["losses"] = list(self.guard.losses)
        if self.average is not None:
            checkpoint["average"] = self.average.state_dict()
        checkpoint["seconds"], checkpoint["windows"] = self.clock.seconds, self.windows_seen
        checkpoint["steps"] = self.steps

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        """Go on with the time and the counts so far."""
        self.guard.losses.extend(checkpoint.get("losses", ()))
        self.clock.seconds = checkpoint.get("seconds", 0.0)
        self.windows_seen = checkpoint.get("windows", 0)
        step = checkpoint["global_step"]
        self.steps_before = checkpoint.get("steps", step) - step
        if self.average is not None:
            self.average.load_state_dict(checkpoint.get("average", self.network.state_dict()))
