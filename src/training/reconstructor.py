"""Training, validation and test of any network that turns voxel grids into frames."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from lightning import LightningModule
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor
from torch.nn.utils import parametrize

from src.losses.terms import TrainingLoss
from src.metrics.video_metrics import VideoMetrics
from src.models.network import EventToVideoNetwork, FramePostprocessor, VideoMethod, unroll
from src.sim import noise
from src.training import resume
from src.training.cuda_graphs import GraphedUnroll
from src.training.ema import select_trained_weights
from src.training.schedule import TrainingClock
from src.training.step_guard import StepGuard

if TYPE_CHECKING:  # a network knows nothing of the simulation; a sample is read, never made
    from src.sim.pipeline import Sample

GRAPHED_SELECTIONS = 4  # of windows, each of which has a CUDA graph of its own


class Reconstructor(LightningModule):
    """Trains `network`; `network_spec` (target and kwargs) builds it again from a checkpoint.

    `loss`, `optimizer` (of parameters) and `scheduler`, if any (of an optimiser, one step a batch),
    are needed to train; `metrics`: of validation and test, None: without LPIPS.  `method`: what is
    validated and tested, None: the network.  `loss_from`, `loss_pairs`: see select_loss_windows,
    whose draws follow from `seed` and the step.
    `cuda_graphs`: on a GPU a sequence is unrolled as CUDA graphs, of a few selections of windows
    only.  The first `unscored_windows` of a clip are not scored.  A test leaves the scores of all
    clips in `clips`, and the first `kept_clips` samples with their frames in `reconstructions`.
    """

    def __init__(
        self,
        network: VideoMethod | FramePostprocessor,
        network_spec: dict,
        *,
        loss: TrainingLoss | None = None,
        optimizer: Callable | None = None,
        scheduler: Callable | None = None,
        metrics: VideoMetrics | None = None,
        method: VideoMethod | None = None,
        loss_from: int = 0,
        loss_pairs: int | None = None,
        guard: StepGuard | None = None,
        clock: TrainingClock | None = None,
        cuda_graphs: bool = False,
        unscored_windows: int = 0,
        kept_clips: int = 0,
        seed: int = 0,
    ):
        super().__init__()
        self.automatic_optimization = False
        self.network, self.network_spec = network, network_spec
        self.metrics = VideoMetrics() if metrics is None else metrics
        self.make_optimizer, self.make_scheduler = optimizer, scheduler
        self.loss_from, self.loss_pairs = loss_from, loss_pairs
        self.guard, self.clock = guard or StepGuard(), clock or TrainingClock()
        self.unscored_windows, self.kept_clips, self.seed = unscored_windows, kept_clips, seed
        self.graphs = GraphedUnroll(network) if cuda_graphs else None  # type: ignore[arg-type]
        self.windows_seen, self.earlier_steps = 0, 0
        self.optimizer_start = 0  # step at which the optimiser's state began
        self.initial_rates: list[float] = []
        # In tuples, so that what is not trained stays out of the parameters and the checkpoint.
        self._loss, self._method = (loss,), (method or network,)
        self.clips: list[dict] = []
        self.reconstructions: list[tuple[Sample, Tensor]] = []

    @property
    def loss(self) -> TrainingLoss:
        """The training loss."""
        (loss,) = self._loss
        assert loss is not None, "a Reconstructor without a loss does not train"
        return loss

    @property
    def method(self) -> VideoMethod:
        """What is validated and tested."""
        (method,) = self._method
        assert isinstance(method, VideoMethod), "a post-processor is scored behind its source"
        return method

    @property
    def steps_so_far(self) -> int:
        """Steps so far, those of the training whose exported weights this continues included."""
        return self.earlier_steps + self.global_step

    def on_fit_start(self) -> None:
        self.loss.to(self.device)  # which is no submodule
        self.train()  # after a test's eval mode
        self._share_scores_of_all_processes()

    def on_train_start(self) -> None:
        self.clock.start()

    def on_validation_end(self) -> None:
        self.clock.start()  # leaves the time of validation out

    def training_step(self, sample: "Sample", batch_idx: int) -> Tensor:
        """Take one optimiser step on a batch of sequences; return its mean loss, also over
        processes, so that all of them decide alike.

        Raises NonFiniteError, with the clips, for a loss or gradient that is not; no step is taken.
        """
        windows = sample.voxels.shape[1]
        step = self.steps_so_far if self.graphs is None else self.global_step % GRAPHED_SELECTIONS
        seed = noise.key(self.seed, "loss windows", step)
        outputs = select_loss_windows(windows, self.loss_from, self.loss_pairs, seed)
        optimizer = self.optimizers()
        assert isinstance(optimizer, LightningOptimizer)
        optimizer.zero_grad()
        if self.graphs is not None and sample.voxels.is_cuda:
            frames = self.graphs(sample.voxels, sample.window_s, sample.positions, outputs)
        else:
            with parametrize.cached():  # spectral norm iterates once, not once per window
                frames = self.reconstruct_windows(sample, outputs)
        if not frames.requires_grad:
            kind = type(self.network).__name__
            raise ValueError(f"{kind} must return frames with a gradient (no detach, no_grad)")
        target, taught = sample.target[:, outputs], sample.teacher_frames
        taught = None if taught is None else taught[:, outputs]
        loss, gradient = self.loss.value_and_gradient(frames, target, outputs, taught)
        self.manual_backward(frames, gradient)
        total = self.all_gather(loss).mean()  # type: ignore[union-attr]
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        self.guard.scale_gradients(gradients, total, self.global_step, sample.parameters)
        optimizer.step()
        if self.make_scheduler is not None:
            self.lr_schedulers().step()  # type: ignore[union-attr]
        self.windows_seen += windows * len(sample.voxels) * self.trainer.world_size
        self.log("train/loss", total, prog_bar=True, batch_size=len(sample.voxels))
        self.clock.lap()
        return total

    def reconstruct_windows(self, sample: "Sample", outputs: Sequence[int]) -> Tensor:
        """Return the frames of the windows `outputs` of the network in training."""
        assert isinstance(self.network, EventToVideoNetwork)
        return unroll(
            self.network, sample.voxels,
            window_s=sample.window_s, positions=sample.positions, output_windows=outputs,
        )[0]  # fmt: skip

    def validation_step(self, sample: "Sample", batch_idx: int) -> None:
        self.reconstruct_and_score(sample)
        self._log_means("val")

    def on_test_start(self) -> None:
        """Forget the clips of an earlier test."""
        self.clips, self.reconstructions = [], []
        self._share_scores_of_all_processes()

    def _share_scores_of_all_processes(self) -> None:
        """Average scores over the processes of this module's trainer, which may be one of several;
        `metrics` may have been those of another module's test before."""
        for metric in self.metrics.values():
            metric.distributed_available_fn = lambda: self.trainer.world_size > 1

    def test_step(self, sample: "Sample", batch_idx: int) -> None:
        self.sample = sample
        frames, scores = self.reconstruct_and_score(sample)
        if len(self.reconstructions) < self.kept_clips:
            self.reconstructions.append((sample, frames))
        self.clips += scores
        self._log_means("test")

    def _log_means(self, split: str) -> None:
        means = {f"{split}/{name}": metric for name, metric in self.metrics.items()}
        self.log_dict(means, on_step=False, on_epoch=True, batch_size=1)

    def reconstruct_and_score(self, sample: "Sample") -> tuple[Tensor, list[dict]]:
        """Add every clip to `metrics`; return the frames, as `sample.target`, and of each clip the
        scores with what was drawn for it."""
        with parametrize.cached():
            frames = self.method.reconstruct_clip(sample)
        scored = slice(self.unscored_windows, None)
        clips = zip(frames[:, scored], sample.target[:, scored], sample.parameters, strict=True)
        scored_clips = []
        for ours, truth, drawn in clips:
            if taken := sorted(drawn.keys() & set(self.metrics.names)):
                why = "a parameter of the clips has that name"
                raise ValueError(f"metrics.{taken[0]} must be called otherwise: {why}")
            scored_clips.append(drawn | self.metrics(ours, truth))
        return frames, scored_clips

    def configure_optimizers(self):
        assert self.make_optimizer is not None
        optimizer = self.make_optimizer(self.network.parameters())
        # Before a checkpoint's are restored, which a schedule has changed.
        self.initial_rates = [group["lr"] for group in optimizer.param_groups]
        if self.make_scheduler is None:
            return optimizer
        return [optimizer], [self.make_scheduler(optimizer)]

    def on_save_checkpoint(self, checkpoint: dict) -> None:
        checkpoint["network"] = self.network_spec  # plain data: loads with weights_only=True
        checkpoint["losses"] = list(self.guard.losses)
        checkpoint["seconds"], checkpoint["windows"] = self.clock.seconds, self.windows_seen
        checkpoint["steps"] = self.steps_so_far
        checkpoint["optimizer_start"] = self.optimizer_start

    def on_load_checkpoint(self, checkpoint: dict) -> None:
        select_trained_weights(self.trainer, checkpoint)
        if self.make_optimizer is not None:  # else nothing is trained
            resume.check_max_steps(self.trainer.max_steps, checkpoint["global_step"])
            kept = resume.apply_config_to_optimizer_state(
                checkpoint, self.network.parameters, self.make_optimizer, self.make_scheduler
            )
            start = checkpoint.get("optimizer_start", 0)
            self.optimizer_start = start if kept else checkpoint["global_step"]
        self.guard.losses.extend(checkpoint["losses"])
        self.clock.seconds, self.windows_seen = checkpoint["seconds"], checkpoint["windows"]
        self.earlier_steps = checkpoint["steps"] - checkpoint["global_step"]


class PostprocessorTraining(Reconstructor):
    """Trains a post-processor on frames; `method` is the network behind its frozen `source`."""

    def on_fit_start(self) -> None:
        super().on_fit_start()
        method: Any = self.method
        method.source.to(self.device)  # which is no submodule

    def reconstruct_windows(self, sample: "Sample", outputs: Sequence[int]) -> Tensor:
        """Return the restored frames `outputs` of the source's frames."""
        method: Any = self.method  # a Postprocessed, of the baselines
        return method.repeat(self.network(method.reconstruct_source(sample))[0], outputs)


def select_loss_windows(windows: int, first: int, pairs: int | None, seed: int) -> list[int]:
    """Return the numbers, ascending, of the windows of a sequence that the loss sees, from `first`
    on; those before fill the state.

    `pairs`: so many pairs of neighbours, one in each equal part of the sequence; None: all.
    """
    if pairs is None:
        return list(range(first, windows))
    generator = torch.Generator().manual_seed(seed)
    ends = [first + part * (windows - first) // pairs for part in range(pairs + 1)]
    starts = [int(torch.randint(a, b - 1, (), generator=generator)) for a, b in pairwise(ends)]
    return [start + offset for start in starts for offset in (0, 1)]
