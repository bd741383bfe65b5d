"""The training loss: the weighted sum of terms, each `loss.<term>: {_target_, weight, ...}`."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from src.metrics.image import Frames, FrameValues, ssim
from src.metrics.lpips import LPIPS

Sequences = Float[Tensor, "n windows 1 h w"]
Mask = Bool[Tensor, " windows-1"]
Value = Float[Tensor, ""]

STATIC_CHANGE = 1 / 512  # half a grey level: a target that changes by less is static
FRAMES_AT_A_TIME = {"cpu": 32, "cuda": 256}  # that losses are computed of
CONTRAST_FLOOR = 0.02  # standard deviation of a frame below which changes are not scaled up further


class LossTerm(nn.Module):
    """A term that counts `weight` times; a term of weight 0 is not built."""

    def __init__(self, weight: float = 1.0):
        super().__init__()
        self.weight = weight


class FrameTerm(LossTerm):
    """A term of single frames: `forward` maps frames and targets (n, 1, h, w) to values (n,).

    `in_distillation`: whether frames are compared with those of teachers by this term, too.
    """

    in_distillation = True


class SequenceTerm(LossTerm):
    """A term of successive frames: `forward` maps frames and targets (n, windows, 1, h, w), and
    whether each window directly follows the one before (windows - 1,), to one value.
    """


class L1Term(FrameTerm):
    """Mean absolute error, unclipped."""

    def forward(self, frames: Frames, target: Frames) -> FrameValues:
        return (frames - target).abs().mean((1, 2, 3))


class SSIMTerm(FrameTerm):
    """1 - SSIM (Zhao et al., IEEE TCI 2017); ValueError for frames smaller than 11 pixels."""

    def forward(self, frames: Frames, target: Frames) -> FrameValues:
        return 1 - ssim(frames, target)


class LPIPSTerm(FrameTerm):
    """LPIPS; `net`, `backbone_weights` and errors: see src/metrics/lpips.py."""

    in_distillation = False  # perceptual detail is learned from the truth alone

    def __init__(self, weight: float = 1.0, net: str = "alex", backbone_weights: str | None = None):
        super().__init__(weight)
        self.lpips = LPIPS(net, backbone_weights, key="loss.lpips")

    def forward(self, frames: Frames, target: Frames) -> FrameValues:
        return self.lpips(frames, target)


class TemporalConsistency(SequenceTerm):
    """Mean absolute change of the error from one window to the next."""

    def forward(self, frames: Sequences, target: Sequences, is_consecutive: Mask) -> Value:
        return (frames - target).diff(dim=1)[:, is_consecutive].abs().mean()


class StaticFlicker(SequenceTerm):
    """Mean absolute change of a frame where the target is static, relative to its contrast (else a
    fainter frame would cost less).
    """

    def forward(self, frames: Sequences, target: Sequences, is_consecutive: Mask) -> Value:
        change = frames.diff(dim=1)[:, is_consecutive].abs()
        is_static = target.diff(dim=1)[:, is_consecutive].abs() < STATIC_CHANGE
        contrast = (frames.var((-2, -1), keepdim=True) + CONTRAST_FLOOR**2).sqrt()
        return (change * is_static / contrast[:, 1:][:, is_consecutive]).mean()


class Distillation(LossTerm):
    """The frame terms against the frames of teachers (Hinton et al. 2015): those with
    `in_distillation`, or all where none has it.
    """

    def forward(
        self, frames: Frames, teacher_frames: Frames, terms: Sequence[FrameTerm]
    ) -> FrameValues:
        compared = [term for term in terms if term.in_distillation] or terms
        return weighted_sum(compared, frames, teacher_frames)


def weighted_sum(terms: Sequence[FrameTerm], frames: Frames, target: Frames) -> FrameValues:
    """Return the sum of frame terms times their weights, one value per frame."""
    return reduce(torch.add, (term.weight * _per_frame(term, frames, target) for term in terms))


def _per_frame(term: FrameTerm, frames: Frames, target: Frames) -> FrameValues:
    values = term(frames, target)
    if values.shape != frames.shape[:1]:
        wanted, got = tuple(frames.shape[:1]), tuple(values.shape)
        raise ValueError(f"{type(term).__name__} must return a value per frame {wanted}, got {got}")
    return values


def _one_value(
    term: SequenceTerm, frames: Sequences, target: Sequences, is_consecutive: Mask
) -> Value:
    """Return the value of `term` times its weight."""
    value = term(frames, target, is_consecutive)
    if value.shape != ():
        got = f"shape {tuple(value.shape)}"
        raise ValueError(f"{type(term).__name__} must return one value, of shape (), got {got}")
    return term.weight * value


class TrainingLoss(nn.Module):
    """The sum of `terms`, by name.  Raises ValueError for a term of another kind than a frame term,
    a sequence term or distillation, for one with parameters to train, which no optimiser is given,
    and where no frame term is left.
    """

    def __init__(self, terms: Mapping[str, LossTerm]):
        super().__init__()
        for name, term in terms.items():
            if not isinstance(term, FrameTerm | SequenceTerm | Distillation):
                raise ValueError(
                    f"loss.{name}._target_ must be a FrameTerm or a SequenceTerm "
                    f"(src.losses.terms), got {type(term).__name__}"
                )
            if any(parameter.requires_grad for parameter in term.parameters()):
                raise ValueError(
                    f"loss.{name} must have no parameters to train (requires_grad_(False)): only "
                    "those of the network are trained"
                )
        self.terms = nn.ModuleDict(terms)
        self.frame_terms = [term for term in terms.values() if isinstance(term, FrameTerm)]
        self.sequence_terms = [term for term in terms.values() if isinstance(term, SequenceTerm)]
        self.distillation = next((t for t in terms.values() if isinstance(t, Distillation)), None)
        if not self.frame_terms:
            raise ValueError("loss must have a frame term of weight > 0, such as loss.l1.weight=1")

    def forward(self, frames: Frames, target: Frames) -> FrameValues:
        """Return the weighted sum of the frame terms, one value per frame."""
        return weighted_sum(self.frame_terms, frames, target)

    def value_and_gradient(
        self,
        frames: Sequences,
        target: Sequences,
        windows: list[int],
        teacher_frames: Sequences | None = None,
    ) -> tuple[Value, Sequences]:
        """Return the mean loss of frames and its gradient with respect to them.

        `windows`: the number of each window in its sequence.  A few frames are computed at a time,
        so that feature maps (VGG's are larger than the network's) are never in memory together.
        """
        leaf = frames.detach().flatten(0, 1).float().requires_grad_()
        value = _backward_frames(self, leaf, target.flatten(0, 1))
        if teacher_frames is not None and (taught := self.distillation) is not None:
            compare = partial(taught, terms=self.frame_terms)
            value += _backward_frames(compare, leaf, teacher_frames.flatten(0, 1), taught.weight)
        is_consecutive = torch.tensor([b == a + 1 for a, b in pairwise(windows)])
        if self.sequence_terms and is_consecutive.any():
            ours = leaf.unflatten(0, frames.shape[:2])
            parts = [_one_value(t, ours, target, is_consecutive) for t in self.sequence_terms]
            part = torch.stack(parts).sum()
            part.backward()
            value += part.detach()
        assert leaf.grad is not None
        return value, leaf.grad.to(frames.dtype).view_as(frames)


def _backward_frames(compare: Callable, leaf: Tensor, target: Tensor, weight: float = 1) -> Tensor:
    """Add the gradient of the weighted mean of `compare(frames, target)` to `leaf`; return it."""
    size = FRAMES_AT_A_TIME["cuda" if leaf.is_cuda else "cpu"]
    value = torch.zeros((), device=leaf.device)
    for ours, theirs in zip(leaf.split(size), target.split(size), strict=True):
        part = (weight * compare(ours, theirs)).sum() * (1 / len(leaf))
        part.backward()
        value += part.detach()
    return value
