"""Reconstruction straight from lists of events, where the network can: no grid is made."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch
from torch import nn

from src.models.aligned import Aligned
from src.models.fast import running
from src.models.runtime import FORMS, Runtime, runs
from src.recordings.stream import Carry, Frame, Window, carried
from src.recordings.views import Views


def ready(
    network: nn.Module, form: str, device: str, views: Views, bins: int, align: str | None = None
) -> nn.Module | Runtime:
    """Return `network` as it is run: on a CPU a Runtime where there is one for it, but not where
    views are to be aligned, which takes grids (aligned.py).

    Raises ValueError for a form, a device or a number of bins that do not go together.
    """
    if device != "cpu" and form == "openvino":
        raise ValueError(f"device must be cpu for form=openvino, got {device}")
    if align:
        return Aligned(running(network, form), align).to(device)
    if device != "cpu" or form not in FORMS or not runs(network):
        return running(network, form).to(device)
    if bins != network.bins:
        raise ValueError(f"bins must be {network.bins} for this network, got {bins}")
    height, width = views.model
    threads = torch.get_num_threads()
    return Runtime(
        network, positions=views.positions, height=height, width=width, threads=threads, form=form
    )


def frames(
    windows: Iterable[Window], runtime: Runtime, *, overlap: int = 1, carry: Carry | None = None
) -> Iterator[Frame]:
    """As `stream.frames`, of windows without grids (`Rule.grids`)."""

    def step(window: Window, state: Any) -> tuple[np.ndarray, Any]:
        runtime.state = state
        picture = runtime.step(*window.parts, 0.0, window.seconds)
        return picture, runtime.state

    return carried(windows, step, runtime.size, overlap, carry)
