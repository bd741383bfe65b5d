"""Frames as a method, and a post-processor behind any method: what the paper compares events with.

Both make a whole video at once, `video(sample)`; see `src.models.unroll.video`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.models import files
from src.models.unroll import takes, video
from src.training.reconstructor import Reconstructor

if TYPE_CHECKING:
    from src.sim.pipeline import Sample


class CameraFrames(nn.Module):
    """The turbulent frames themselves, as a camera behind the centre view gives them.

    `average`: consecutive frames that one exposure lasts; such a camera has one picture for so many
    windows, shown in all of them (the paper's figure 7: 4).
    """

    views = None

    def __init__(self, average: int = 1):
        super().__init__()
        if average < 1:
            raise ValueError(f"baseline.average must be >= 1, got {average}")
        self.average = average

    def video(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        """Return the mean of every `average` frames in the place of each of them."""
        pictures = [part.mean(1, keepdim=True) for part in sample.turbulent.split(self.average, 1)]
        shown = torch.cat(pictures, 1).repeat_interleave(self.average, 1)
        return shown[:, : sample.turbulent.shape[1]]


class Postprocessed(nn.Module):
    """A post-processor behind `source`: video in, video out, in windows of `window` frames that
    share `overlap`.  A source with fewer pictures than windows gives each of them once.

    `restorer`: the post-processor, or a name in weights/ or a path of its weights, of one of the
    packages `rooms` if not of ours.
    """

    def __init__(
        self,
        source: nn.Module,
        restorer: nn.Module | str,
        window: int = 16,
        overlap: int = 4,
        rooms: Sequence[str] = (),
    ):
        super().__init__()
        self.source = source
        self.restorer = load(restorer, rooms) if isinstance(restorer, str) else restorer
        self.views, self.window, self.overlap = source.views, window, overlap

    @torch.no_grad()
    def video(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        """Return the restored frame of every window, in [0, 1]."""
        frames = video(self.source, sample).float().clamp(0, 1)
        every = getattr(self.source, "average", 1)
        restored = self.restorer.restore(
            frames[:, ::every], window=self.window, overlap=self.overlap
        )
        return restored.repeat_interleave(every, 1)[:, : frames.shape[1]]


class Restoration(Reconstructor):
    """Training of a post-processor on the frames that `source`, frozen, makes of each sample."""

    def __init__(self, network: nn.Module, network_spec: dict, *, source: nn.Module, **how: Any):
        super().__init__(network, network_spec, **how)
        self._source = (source.eval().requires_grad_(False),)  # not part of the checkpoint

    @property
    def method(self) -> Postprocessed:
        """The network behind its source."""
        return Postprocessed(self._source[0], super().method)

    def unrolled(
        self,
        sample: "Sample",
        part: slice,
        state: Any = None,
        shown: Sequence[int] | None = None,
    ) -> tuple[Tensor, None]:
        """Return what the post-processor makes of a `part` of the source's frames; no state."""
        with torch.no_grad():
            seen = video(self._source[0].to(self.device), sample).float().clamp(0, 1)
        restored = self.network(seen[:, part])[0]
        return restored if shown is None else restored[:, shown], None


def load(weights: str, rooms: Sequence[str] = ()) -> nn.Module:
    """Return the frozen post-processor of a name in weights/ or a path.

    Raises ValueError, which says how to make it, where there is none.
    """
    try:
        restorer = files.load(weights, rooms)
    except ValueError as error:
        raise ValueError(
            f"postprocess.restorer must be a name in weights/ or a path, got {weights} ({error}); "
            "make one with `python -m src.train experiment=mambatm` and scripts.ship_weights"
        ) from error
    if not takes(restorer, "frames"):
        kind = type(restorer).__name__
        raise ValueError(f"postprocess.restorer must be a post-processor, got a {kind}")
    return restorer.requires_grad_(False)
