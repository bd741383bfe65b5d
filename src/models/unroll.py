"""A network over a sequence of windows."""

import inspect
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

if TYPE_CHECKING:
    from src.sim.pipeline import Sample

AT_ONCE = 40  # windows; more take more memory and no less time


def unroll(
    network: nn.Module,
    voxels: Float[Tensor, "n windows views bins h w"],
    state: Any = None,
    *,
    window_s: float | Tensor = 1 / 120,
    positions: Sequence[tuple[int, int]] | None = None,
    shown: Sequence[int] | None = None,
) -> tuple[Float[Tensor, "n shown 1 h w"], Any]:
    """Return the frames of the windows `shown`, ascending (None: of all), and the state after the
    last window.

    `window_s`, the length of a window in seconds, a number or one per clip (n,), and `positions`,
    the (row, col) of every view, are given to a network that takes them.  One that has a method
    `sequence`, as `forward` but for many windows, is given AT_ONCE of them and which are shown; one
    that has `remember`, windows that are not shown: it returns the state alone.
    """
    options = accepted(network, window_s=window_s, positions=positions)
    frames = []
    if hasattr(network, "sequence"):
        for part in chunks(voxels.shape[1], AT_ONCE):
            options["shown"] = None if shown is None else within(shown, part)
            some, state = network.sequence(voxels[:, part], state, **options)
            frames.append(some)
        return torch.cat(frames, dim=1), state
    for number, window in enumerate(voxels.unbind(1)):
        wanted = shown is None or number in shown
        if not wanted and hasattr(network, "remember"):
            state = network.remember(window, state, **options)
            continue
        frame, state = network(window, state, **options)
        if wanted:
            frames.append(frame)
    return torch.stack(frames, dim=1), state


def within(shown: Sequence[int], part: slice) -> list[int]:
    """Return those of the windows `shown` that lie in `part`, counted from its first."""
    return [window - part.start for window in shown if part.start <= window < part.stop]


def video(method: nn.Module, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
    """Return what `method` makes of a whole sample, a frame for each window.

    A method that does not go window by window (frames in, or a post-processor behind) has a `video`
    of its own; it has the attribute `views` as every network.
    """
    if hasattr(method, "video"):
        return method.video(sample)
    options = {"window_s": sample.window_s, "positions": sample.positions}
    return unroll(method, sample.voxels, **options)[0]


def takes(network: nn.Module, name: str) -> bool:
    """Return whether the network's `forward` has a parameter `name`."""
    return name in inspect.signature(network.forward).parameters


def accepted(network: nn.Module, **options: Any) -> dict[str, Any]:
    """Return those of `options` that the network's `forward` takes."""
    return {name: value for name, value in options.items() if takes(network, name)}


def chunks(windows: int, length: int) -> Iterator[slice]:
    """Yield slices of at most `length` windows (0: all at once) that cover `windows`."""
    length = length or windows
    for start in range(0, windows, length):
        yield slice(start, min(start + length, windows))


def detach(state: Any) -> Any:
    """Return `state`, a tensor or nested tuples, lists and dicts of tensors, cut from its graph."""
    if isinstance(state, Tensor):
        return state.detach()
    if isinstance(state, tuple | list):
        return type(state)(detach(part) for part in state)
    if isinstance(state, dict):
        return {name: detach(part) for name, part in state.items()}
    return state
