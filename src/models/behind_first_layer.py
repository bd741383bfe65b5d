"""What comes behind the first layer of a network, for one clip: maps in, frame and state out.

Maps come channels last, as events are added to them; `kernel`, `bias`, `stride` and `views` say
what the first layer is, `between` what is enough while one does not look around.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.models import openvino_cpu, stopwatch
from src.models.e2vid import E2VID
from src.models.explicit_state import flat, formed
from src.models.setnet import CELL, SetNet, faded
from src.models.setnet_layers import FourCells, PartedUnit, channels_first, channels_last
from src.sim.optics import Position


class AfterHead(nn.Module):
    """`E2VID` behind its first layer; `padded`: (h, w) of its map."""

    def __init__(
        self,
        network: E2VID,
        positions: Sequence[Position],
        padded: tuple[int, int],
        dtype: torch.dtype,
    ):
        super().__init__()
        if len(positions) != network.views:
            raise ValueError(
                f"optics.views must be {network.views} for this network, got {len(positions)}"
            )
        self.views, self.stride, self.padded = network.views, 1, padded
        self.kernel, self.bias = (part.float().numpy() for part in network.first.parameters())
        self.network = network.to(dtype)
        self.dtype = dtype
        nothing = torch.zeros(1, *padded, len(self.kernel))
        with torch.no_grad():
            _, self.form = self.network.after_first(self._seen(nothing), None)

    def start(self) -> list[Tensor]:
        """Return the state before the first window."""
        return [torch.zeros_like(part) for part in flat(self.form)]

    def forward(self, head: Float[Tensor, "1 h w c"], *state: Tensor) -> tuple[Tensor, ...]:
        """Return the frame (1, 1, h, w), float32, and the parts of the state."""
        frame, after = self.network.after_first(self._seen(head), formed(self.form, iter(state)))
        return frame.float(), *flat(after)

    def between(self) -> None:
        """Return nothing: no part of it rests."""

    def _seen(self, head: Tensor) -> Tensor:
        return head.permute(0, 3, 1, 2).to(self.dtype)


class AfterStem(nn.Module):
    """`SetNet` behind the stacked grids; `padded`: (h, w) of a grid, multiples of 8."""

    def __init__(
        self,
        network: SetNet,
        positions: Sequence[Position],
        padded: tuple[int, int],
        dtype: torch.dtype,
    ):
        super().__init__()
        self.views, self.stride = len(positions), CELL
        places = network.places(self.views, network.bins, positions)
        grids, _, bias = network.kernels(places)
        self.kernel, self.bias = grids.numpy(), bias.numpy()
        code, memories = _memories(network, places)
        self.code, self.memories = code.numpy(), memories.to(dtype)
        self.sizes = [(1, h, w, c) for c, h, w in network.hidden(*padded)]
        network.cell2 = PartedUnit(network.cell2)
        network.shuffle = FourCells(network.shuffle, CELL)
        self.network = network.to(dtype)
        self.dtype = dtype

    def start(self) -> list[Tensor]:
        """Return the state before the first window."""
        return [torch.zeros(size) for size in self.sizes]

    def forward(
        self,
        grids: Float[Tensor, "1 hc wc stem"],
        mixed: Float[Tensor, "1 hc wc mixed"],
        passed: Float[Tensor, "1 1 1 1"],
        recent: Float[Tensor, "1 1 1 1"],
        hidden: Float[Tensor, "1 hc wc c"],
        about: Float[Tensor, "1 hq wq c"],
        told: Float[Tensor, "1 hq wq c"],
    ) -> tuple[Tensor, ...]:
        """Return the pixels of every 2 x 2 cells (1, hq, wq, pixels), the hidden map, what lies
        around and what is told of it, all float32.
        """
        seen, hidden = self.network.fine(self.stem(grids, mixed), passed, hidden)
        around = self.network.around
        about = around.mean(channels_first(about), around(seen).float(), recent)
        pixels, told = self.pixels(seen, channels_last(about), told, passed)
        return pixels, hidden, channels_last(about), told

    def between(self) -> nn.Module:
        """Return what a window takes in which one does not look around."""
        return Between(self)

    def stem(self, grids: Tensor, mixed: Tensor) -> Tensor:
        """Return the map of the stem, before its ReLU."""
        grids, mixed = (channels_first(part.to(self.dtype)) for part in (grids, mixed))
        return grids + functional.conv2d(mixed, self.memories, None, 1, 1)

    def pixels(
        self, seen: Tensor, about: Tensor, told: Tensor, passed: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the pixels of every 2 x 2 cells and what is told of what lies around."""
        told = faded(told, about, passed)
        return channels_last(self.network.drawn(seen, channels_first(told)).sigmoid()), told


def _memories(network: SetNet, places: Sequence[Position]) -> tuple[Tensor, Tensor]:
    """Return how much of each mixture is of each view (views, parts), and the kernels of the
    mixtures, of each sum, and of the views' spread: together the stem's, but of as many maps as
    its kernels have parts.
    """
    code, parts = network.sum_stem.parts(torch.tensor(places).float())
    kernels = [parts.transpose(0, 1).flatten(1, 2), network.spread_stem.weight]
    return code, torch.cat(kernels, 1)


class Between(nn.Module):
    """What of `AfterStem` a window takes that is told what lies around."""

    def __init__(self, after: AfterStem):
        super().__init__()
        self.after = after

    def forward(
        self, grids: Tensor, mixed: Tensor, passed: Tensor, hidden: Tensor, about: Tensor,
        told: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        """Return the pixels of every 2 x 2 cells, the hidden map and what is told of what lies
        around.
        """
        stem = self.after.stem(grids, mixed)
        seen, hidden = self.after.network.fine(stem, passed, hidden)
        pixels, told = self.after.pixels(seen, about, told, passed)
        return pixels, hidden, told


class Behind:
    """Runs what comes behind the first layer and keeps its state.

    `make` gives for a module, its inputs and a number of threads what runs it, an `OnTorch`, say.
    """

    def __init__(
        self, after: AfterHead | AfterStem, inputs: list[np.ndarray], make: Callable, threads: int
    ):
        given, state, between = [*map(torch.from_numpy, inputs)], after.start(), after.between()
        if between is None:
            self.between = None
        else:
            self.between = make(between, [*given[:-2], *state], threads)
            given.pop()  # whether to look around
        self.whole = make(after, [*given, *state], threads)
        self.given = len(given)
        self.reset()

    def __call__(self, inputs: list[np.ndarray]) -> np.ndarray:
        """Return what is drawn and keep the state."""
        if self.between is None:
            drawn, *self.state = self.whole(inputs, self.state)
            return drawn
        *seen, recent, due = inputs
        if due.any():
            drawn, *self.state = self.whole([*seen, recent], self.state)
        else:
            hidden, about, told = self.state
            drawn, hidden, told = self.between(seen, [hidden, about, told])
            self.state = [hidden, about, told]
        return drawn

    def reset(self) -> None:
        """Start from zeros."""
        self.state = self.whole.zeros(self.given)


class OnTorch:
    """A module of `example`'s sizes on PyTorch: arrays and a state in, an array and a state out."""

    def __init__(self, module: nn.Module, example: list[Tensor], threads: int):
        self.module = module.to(memory_format=torch.channels_last)
        self.example, self.threads = example, threads

    @torch.inference_mode()
    def __call__(self, inputs: list[np.ndarray], state: list[Tensor]) -> list:
        """Return what is drawn and the state."""
        with stopwatch.threads(self.threads):
            drawn, *state = self.module(*map(torch.from_numpy, inputs), *state)
        return [drawn.numpy(), *state]

    def zeros(self, first: int) -> list[Tensor]:
        """Return zeros for the inputs from the `first` on."""
        return [torch.zeros_like(part) for part in self.example[first:]]


class OnOpenVino(openvino_cpu.Compiled):
    """As OnTorch, on OpenVINO."""

    def __call__(self, inputs: list[np.ndarray], state: list) -> list:
        """Return what is drawn and the state."""
        self.drawn, *state = super().__call__([*map(openvino_cpu.shared, inputs), *state])
        return [self.drawn.data, *state]  # an array does not keep its tensor alive
