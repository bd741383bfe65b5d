"""Windows of a recording to frames: on voxel grids or, where the network can, on event lists."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from src.deploy.forms import convert_to_form
from src.deploy.runtime import EVENT_LIST_FORMS, EventListRuntime, supports_event_lists
from src.models.network import EventToVideoNetwork
from src.recordings.event_windows import Window, WindowRule, cut_windows, cut_windows_backward
from src.recordings.sensor_lookup import build_lookup
from src.recordings.views import Views
from src.sim.optics import Position, is_arranged_as_layout, layout

RunnableNetwork = EventToVideoNetwork | EventListRuntime


@dataclass(frozen=True)
class Frame:
    """A picture (h, w), or (h, w, 3) of a film, float32 in [0, 1] at `time_s`, the end of its
    window; of this window's events the number of those in views, `events`, and of those in no view,
    `events_outside`."""

    time_s: float
    picture: Float[np.ndarray, "h w *rgb"]
    events: int
    events_outside: int


class ReconstructionState:
    """What lives from frame to frame: the recurrent state of each phase of overlapping windows,
    the last picture and the end of the first window."""

    def __init__(self, overlapping_windows: int = 1):
        self.states: list[Any] = [None] * overlapping_windows
        self.picture: Float[np.ndarray, "h w"] | None = None
        self.first_end_us: float | None = None

    def state_index(self, window: Window) -> int:
        """Return which of `states` is of `window`; windows in between may be missing."""
        if self.first_end_us is None:
            self.first_end_us = window.end_us
        period_us = (window.end_us - window.start_us) / len(self.states)
        return round(abs(window.end_us - self.first_end_us) / period_us) % len(self.states)

    def reverse(self) -> None:
        """After windows backward in time, continue with the same windows forward."""
        self.states.reverse()
        self.first_end_us = None


def require_event_network(method: nn.Module) -> EventToVideoNetwork:
    """Return `method`; raises ValueError unless it is a network that events can be fed to."""
    if not isinstance(method, EventToVideoNetwork):
        name = type(method).__name__
        raise ValueError(f"ckpt or baseline must name a network of events, got {name}")
    return method


def accepts_views(network: EventToVideoNetwork, positions: Sequence[Position]) -> bool:
    """Return whether `network` can be given views at `positions`, or the centre one of them."""
    wants = network.views
    return wants in (None, 1) or (wants == len(positions) and is_arranged_as_layout(positions))


def takes_all_views(
    network: EventToVideoNetwork, positions: Sequence[Position], views_file: str | None = None
) -> bool:
    """Return whether `network` takes all views, at `positions`; False: the centre view alone.

    Raises ValueError where it wants another number of views, or others than are there; it names
    the `views_file` that they are from, or says that one is missing.
    """
    wants, views = network.views, len(positions)
    if wants not in (None, 1, views):
        where = "the recording" if views_file is None else f"views={views_file}"
        how = "; give views=views.yaml" if views_file is None and views == 1 else ""
        raise ValueError(f"ckpt wants {wants} views, {where} has {views}{how}")
    if not accepts_views(network, positions):
        arranged = f"arranged as {list(layout(views))}"
        raise ValueError(f"ckpt wants views {arranged}, the recording has {list(positions)}")
    return views == 1 or (wants != 1 and not network.uses_centre_view_only)


def default_window_length(network: EventToVideoNetwork) -> Literal["growing", "trained"]:
    """Return `growing` for a network that uses its window's length, else `trained`: most fade when
    fed shorter windows than in training."""
    return "growing" if network.uses_window_length else "trained"


def build_runnable_network(
    network: EventToVideoNetwork, form: str, device: str, views: Views, bins: int
) -> RunnableNetwork:
    """Return `network` as it is run: on a CPU an EventListRuntime where there is one for it.

    Raises ValueError for a form, a device or a number of bins that do not go together.
    """
    if device != "cpu" and form == "openvino":
        raise ValueError(f"device must be cpu for form=openvino, got {device}")
    if device != "cpu" or form not in EVENT_LIST_FORMS or not supports_event_lists(network):
        return convert_to_form(network, form).to(device)
    if bins != network.bins:
        raise ValueError(f"bins must be {network.bins} for this network, got {bins}")
    sides = dict(zip(("height", "width"), views.model, strict=True))
    threads = torch.get_num_threads()
    return EventListRuntime(network, positions=views.positions, threads=threads, form=form, **sides)


def reconstruct_recording(
    read_events: Callable[[], Iterable[np.ndarray]], network: RunnableNetwork, views: Views,
    rule: WindowRule, backward_warmup_s: float = 0.0, *, device: torch.device | str = "cpu",
) -> Iterator[Frame]:  # fmt: skip
    """Yield the frames of the recording whose chunks `read_events` returns, each time it is called.

    The network first reads `backward_warmup_s` backward, so that the first frame shows the scene.
    """
    lookup, state = build_lookup(views), ReconstructionState(rule.overlapping_windows)
    run = partial(reconstruct_frames, network=network, positions=views.positions, state=state)
    if backward_warmup_s:
        windows = cut_windows_backward(read_events(), lookup, rule, backward_warmup_s)
        for _ in run(windows, device=device):
            pass
        state.reverse()
    yield from run(cut_windows(read_events(), lookup, rule), device=device)


def reconstruct_frames(
    windows: Iterable[Window], network: RunnableNetwork,
    positions: Sequence[Position] | None = None, state: ReconstructionState | None = None, *,
    device: torch.device | str = "cpu",
) -> Iterator[Frame]:  # fmt: skip
    """Reconstruct one frame per window; one without events holds the picture, at next to no cost,
    from where the network `is_settled`.

    `windows` hold lists of events for an EventListRuntime, else grids.  `state`, kept up to date,
    with the rule's `overlapping_windows`, makes this call the continuation of an earlier one.
    """
    state = ReconstructionState() if state is None else state
    for window in windows:
        index = state.state_index(window)
        before = after = state.states[index]
        if window.events or not network.is_settled(before):
            picture, after = _run(network, window, before, positions, device)
            state.picture = picture.clip(0, 1)
        elif window.keeps_state:
            after = network.advance_without_events(before, window.length_s)
        if window.keeps_state:
            state.states[index] = after
        if state.picture is None:
            if isinstance(network, EventListRuntime):
                size: tuple[int, ...] = network.size
            else:
                size = _voxels(window).shape[-2:]
            state.picture = np.full(size, 0.5, np.float32)
        yield Frame(window.end_us * 1e-6, state.picture, window.events, window.events_outside)


def _run(
    network: RunnableNetwork, window: Window, state: Any, positions: Any, device: Any
) -> tuple[np.ndarray, Any]:
    if isinstance(network, EventListRuntime):
        assert window.event_list is not None
        network.state = state if window.keeps_state else deepcopy(state)  # it is advanced in place
        return network.step(*window.event_list, 0.0, window.length_s), network.state
    grid = np.require(_voxels(window), requirements="W")  # that of no events is not
    voxels = torch.from_numpy(grid)[None].to(device)
    with torch.inference_mode():
        picture, state = network(voxels, state, window_s=window.length_s, positions=positions)
    return picture[0, 0].float().cpu().numpy(), state


def _voxels(window: Window) -> Float[np.ndarray, "views bins h w"]:
    assert window.voxels is not None, "windows of event lists are for an EventListRuntime"
    return window.voxels


def reconstruct_each_view(
    windows: Iterable[Window], network: EventToVideoNetwork, overlapping_windows: int = 1
) -> Iterator[Float[np.ndarray, "views h w"]]:
    """Yield the pictures of each window on a grid, as `reconstruct_frames` of a network of one view
    gives them for each view by itself; without events is a window that has none in all views."""
    states: list[ReconstructionState] = []
    for window in windows:
        views = [replace(window, voxels=view[None]) for view in _voxels(window)]
        states = states or [ReconstructionState(overlapping_windows) for _ in views]
        frames = (
            reconstruct_frames([view], network, [(0, 0)], state)
            for view, state in zip(views, states, strict=True)
        )
        yield np.stack([next(frame).picture for frame in frames])
