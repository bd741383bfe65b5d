"""The contract of every network here, and how one is run over a sequence of windows."""

import math
import warnings
from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from src.sim.optics import Position

if TYPE_CHECKING:  # a network knows nothing of the simulation; a sample is read, never made
    from src.sim.pipeline import Sample

WINDOW_S = 1 / 120  # default length of a window, that of training
LONGEST_WINDOW_S = 10.0  # beyond, times are hardly in seconds
LEAST_SIDE_PX = 4  # of voxels: what reflection pads to a multiple of 8
MAX_WINDOWS = 40  # that a network is given at once; more take more memory and no less time


class VideoMethod(nn.Module):
    """Anything that turns a clip into frames; `views`: how many it takes, None: any number."""

    views: int | None = None

    def reconstruct_clip(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        """Return the frame at the end of every window of `sample`."""
        raise NotImplementedError


class EventToVideoNetwork(VideoMethod):
    """A recurrent network from event voxel grids to frames in [0, 1], window by window.

    A subclass implements `forward`; `warm_up` and `sequence` may be replaced by faster ones that
    give the same, `is_settled` and `advance_without_events` by ones that spare it windows without
    events.  The state, a tensor or nested tuples, lists and dicts of tensors, is never kept inside.
    `uses_window_length`: whether windows may last longer or shorter than in training;
    `uses_centre_view_only`: whether the other views it is given change nothing.
    """

    uses_window_length = False
    uses_centre_view_only = False

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame at the end of the window and the state to go on from.

        `state`: None starts a sequence.  `window_s`: length of the window in seconds, a number or
        one per clip (n,).  `positions`: (row, col) of each view, None: `optics.layout`.
        """
        raise NotImplementedError

    def warm_up(
        self, voxels: Float[Tensor, "n views bins h w"], state: Any = None, **options: Any
    ) -> Any:
        """Return the state that `forward` returns, for windows whose frame is not wanted."""
        return self(voxels, state, **options)[1]

    def is_settled(self, state: Any) -> bool:
        """Return whether the frame stays as it is until there are events: a network that does not
        use the window's length is not run without events."""
        return not self.uses_window_length

    def advance_without_events(self, state: Any, seconds: float) -> Any:
        """Return the state after `seconds` without events, of one that `is_settled`."""
        return state

    def sequence(
        self,
        voxels: Float[Tensor, "n windows views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
        output_windows: Sequence[int] | None = None,
    ) -> tuple[Float[Tensor, "n outputs 1 h w"], Any]:
        """Return the frames of `output_windows`, ascending (None: all), and the state after the
        last window.
        """
        frames, options = [], {"window_s": window_s, "positions": positions}
        for number, window in enumerate(voxels.unbind(1)):
            if output_windows is None or number in output_windows:
                frame, state = self(window, state, **options)
                frames.append(frame)
            else:
                state = self.warm_up(window, state, **options)
        if not frames:
            return voxels.new_empty(len(voxels), 0, 1, *voxels.shape[-2:]), state
        return torch.stack(frames, dim=1), state

    def reconstruct_clip(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        voxels, window_s, positions = sample.voxels, sample.window_s, sample.positions
        return unroll(self, voxels, window_s=window_s, positions=positions)[0]


def check_voxel_shape(voxels: Tensor) -> None:
    """Raise ValueError unless `voxels` is a tensor with the five sides of a window's grids, height
    and width of LEAST_SIDE_PX or more."""
    if not isinstance(voxels, Tensor):
        raise ValueError(f"voxels must be a tensor, got {type(voxels).__name__}")
    if voxels.ndim != 5:
        wanted = "voxels must be (clips, views, bins, height, width)"
        raise ValueError(f"{wanted}, got {tuple(voxels.shape)}")
    if min(voxels.shape[-2:]) < LEAST_SIDE_PX:
        wanted = f"voxels must be {LEAST_SIDE_PX} px or more in height and width"
        raise ValueError(f"{wanted}, got {tuple(voxels.shape)}")


def refuse_frame_with_state(state: Any) -> None:
    """Raise ValueError for the pair (frame, state) that a network returns, given as its state."""
    is_pair = isinstance(state, tuple) and len(state) == 2
    if is_pair and isinstance(state[0], Tensor) and not isinstance(state[1], Tensor):
        raise ValueError("state must be the second of the two that a network returns, got both")


def check_state_sizes(state: Any, sizes: Sequence[tuple[int, ...]]) -> None:
    """Raise ValueError unless the tensors of `state`, in order, have these `sizes`, and for the
    pair (frame, state)."""
    refuse_frame_with_state(state)
    found = [tuple(getattr(leaf, "shape", ())) for leaf in pytree.tree_leaves(state)]
    if found != list(sizes):
        raise ValueError(f"state must have sizes {list(sizes)} for these voxels, got {found}")


def check_window_length(window_s: float | Tensor) -> None:
    """Raise ValueError unless `window_s` is finite and > 0 seconds, and warn of one that is longer
    than LONGEST_WINDOW_S; a tensor on a GPU, which would be synchronised, and what is traced are
    not looked at.
    """
    if torch.compiler.is_compiling():
        return
    if isinstance(window_s, Tensor):
        if window_s.device.type != "cpu" or torch.jit.is_tracing() or not window_s.numel():
            return
        least, longest = window_s.min().item(), window_s.max().item()
    elif isinstance(window_s, Real):
        least = longest = float(window_s)
    else:
        raise ValueError(f"window_s must be > 0 seconds, got {window_s!r}")
    if not 0 < least <= longest < math.inf:
        got = window_s.tolist() if isinstance(window_s, Tensor) else window_s
        raise ValueError(f"window_s must be > 0 seconds, got {got}")
    if longest > LONGEST_WINDOW_S:
        warnings.warn(f"a window lasts {longest:g} s: is window_s in seconds?", stacklevel=2)


class FramePostprocessor(nn.Module):
    """A network from distorted frames to restored ones; a subclass implements `forward`."""

    WINDOW, OVERLAP = 16, 4

    def forward(
        self, frames: Float[Tensor, "n frames c h w"]
    ) -> tuple[Float[Tensor, "n frames c h w"], Any]:
        """Return the restored frames, not clipped, and what else training may use."""
        raise NotImplementedError

    @torch.no_grad()
    def restore(self, frames: Float[Tensor, "n frames c h w"]) -> Float[Tensor, "n frames c h w"]:
        """Return a video of any length, restored, in [0, 1], in windows of WINDOW frames that share
        OVERLAP: of two, each gives the half that lies deeper in it.
        """
        count, parts, done = frames.shape[1], [], 0
        last = max(count - self.WINDOW, 0)  # ends with the video, and may share more
        starts = [*range(0, last, self.WINDOW - self.OVERLAP), last]
        for start, following in zip(starts, [*starts[1:], count], strict=True):
            stop = min(start + self.WINDOW, count)
            until = count if stop == count else (stop + following + 1) // 2
            restored, _ = self(frames[:, start:stop])
            parts.append(restored[:, done - start : until - start])
            done = until
        return torch.cat(parts, 1).clamp(0, 1)


def unroll(
    network: EventToVideoNetwork,
    voxels: Float[Tensor, "n windows views bins h w"],
    state: Any = None,
    *,
    window_s: float | Tensor = WINDOW_S,
    positions: Sequence[Position] | None = None,
    output_windows: Sequence[int] | None = None,
) -> tuple[Float[Tensor, "n outputs 1 h w"], Any]:
    """Return what `network.sequence` does, of a sequence of any length: MAX_WINDOWS at a time.

    Raises ValueError for a network whose frames are not of this shape.
    """
    frames, wanted = [], output_windows
    for k, part in enumerate(voxels.split(MAX_WINDOWS, 1)):
        if output_windows is not None:  # counted from the first of the part
            wanted = [w % MAX_WINDOWS for w in output_windows if w // MAX_WINDOWS == k]
        some, state = network.sequence(
            part, state, window_s=window_s, positions=positions, output_windows=wanted
        )
        size = (len(voxels), 1, *voxels.shape[-2:])
        if (*some.shape[:1], *some.shape[2:]) != size:
            kind, got = type(network).__name__, (*some.shape[:1], *some.shape[2:])
            raise ValueError(f"{kind} must return frames (clips, 1, h, w) = {size}, got {got}")
        frames.append(some)
    return torch.cat(frames, dim=1), state
