"""Camera frames as a method, and a post-processor behind any method."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from src import COMMAND
from src.models import files
from src.models.network import FramePostprocessor, VideoMethod

if TYPE_CHECKING:
    from src.sim.pipeline import Sample


class CameraFrames(VideoMethod):
    """The turbulent frames themselves, as a camera behind the centre view gives them.

    `exposure_frames`: consecutive frames that one exposure lasts; such a camera has one picture for
    so many windows, repeated in all of them (the paper's figure 8: 4).
    """

    def __init__(self, exposure_frames: int = 1):
        super().__init__()
        if exposure_frames < 1:
            raise ValueError(f"baseline.exposure_frames must be >= 1, got {exposure_frames}")
        self.exposure_frames = exposure_frames

    def reconstruct_clip(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        """Return the mean of the frames of every exposure in the place of each of them."""
        exposures = sample.turbulent.split(self.exposure_frames, 1)
        means = torch.cat([frames.mean(1, keepdim=True) for frames in exposures], 1)
        repeated = means.repeat_interleave(self.exposure_frames, 1)
        return repeated[:, : sample.turbulent.shape[1]]


class Postprocessed(VideoMethod):
    """A post-processor behind `source`: video in, video out.  A source with fewer pictures than
    windows gives each of them once.

    `postprocessor`: the network, or a name in weights/ or a path of its weights, of one of the
    packages `allowed_packages` if not of ours.
    """

    def __init__(
        self,
        source: VideoMethod,
        postprocessor: FramePostprocessor | str,
        allowed_packages: Sequence[str] = (),
    ):
        super().__init__()
        if isinstance(postprocessor, str):
            postprocessor = load_postprocessor(postprocessor, allowed_packages)
        self.source, self.postprocessor = source, postprocessor
        self.views = source.views
        self.windows_per_frame = source.exposure_frames if isinstance(source, CameraFrames) else 1

    @torch.no_grad()
    def reconstruct_source(self, sample: "Sample") -> Float[Tensor, "n frames 1 h w"]:
        """Return each picture of the source once, in [0, 1]."""
        frames = self.source.reconstruct_clip(sample).float().clamp(0, 1)
        return frames[:, :: self.windows_per_frame]

    def repeat(
        self, pictures: Float[Tensor, "n frames 1 h w"], windows: Sequence[int]
    ) -> Float[Tensor, "n windows 1 h w"]:
        """Return the picture of each of `windows`."""
        return pictures[:, [window // self.windows_per_frame for window in windows]]

    @torch.no_grad()
    def reconstruct_clip(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        """Return the restored frame of every window, in [0, 1]."""
        restored = self.postprocessor.restore(self.reconstruct_source(sample))
        return self.repeat(restored, range(sample.voxels.shape[1]))


def load_postprocessor(weights: str, allowed_packages: Sequence[str] = ()) -> FramePostprocessor:
    """Return the frozen post-processor of a name in weights/ or a path.

    Raises ValueError, which says how to make it, where there is none.
    """
    try:
        network = files.load(weights, allowed_packages)
    except ValueError as error:
        raise ValueError(
            "postprocess.postprocessor must be a name in weights/ or a path, got "
            f"{weights} ({error}); make one with `{COMMAND}train experiment=mambatm`"
        ) from error
    if not isinstance(network, FramePostprocessor):
        kind = type(network).__name__
        raise ValueError(f"postprocess.postprocessor must be a post-processor, got a {kind}")
    return network.requires_grad_(False)
