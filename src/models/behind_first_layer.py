"""What comes behind the first layer of a network, for one clip: maps in, frame and state out.

Maps come channels last, as events are added to them; `kernel`, `bias`, `stride` and `views` say
what the first layer is.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.models import openvino_cpu, stopwatch
from src.models.e2vid import E2VID
from src.models.explicit_state import flat, formed
from src.models.setnet import CELL, SetNet
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
        grids, memories, bias = network.kernels(places)
        self.kernel, self.bias = grids.numpy(), bias.numpy()
        self.memories = memories.to(dtype)
        self.skip = np.zeros(0, np.float32) if network.skip is None else network.skip.numpy()
        self.sizes = [(1, *size) for size in network.hidden(*padded)]
        self.network = network.to(dtype)
        self.dtype = dtype

    def start(self) -> list[Tensor]:
        """Return the state before the first window."""
        return [torch.zeros(size) for size in self.sizes]

    def forward(
        self,
        grids: Float[Tensor, "1 hc wc stem"],
        sums: Float[Tensor, "1 sums hc wc"],
        passed: Float[Tensor, "1 1 h8 w8"],
        drawn: Float[Tensor, "1 hc wc pixels"],
        *hidden: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return the pixels of each cell (1, hc, wc, pixels) and the hidden maps, all float32."""
        stem = functional.conv2d(sums.to(self.dtype), self.memories, None, 1, 1)
        stem = stem + grids.permute(0, 3, 1, 2).to(self.dtype)
        x, *hidden = self.network.after_stem(stem, passed, *hidden)
        return (x.permute(0, 2, 3, 1) + drawn).sigmoid(), *hidden


class OnTorch:
    """What comes behind the first layer, on PyTorch."""

    def __init__(self, after: nn.Module, inputs: list, state: list[Tensor], threads: int):
        self.after = after.to(memory_format=torch.channels_last)
        self.threads, self.zeros = threads, state
        self.reset()

    @torch.inference_mode()
    def __call__(self, inputs: list[np.ndarray]) -> np.ndarray:
        """Return what is drawn and keep the state."""
        with stopwatch.threads(self.threads):
            given = [torch.from_numpy(part) for part in inputs]
            drawn, *self.state = self.after(*given, *self.state)
        return drawn.numpy()

    def reset(self) -> None:
        """Start from zeros."""
        self.state = self.zeros


class OnOpenVino:
    """What comes behind the first layer, on OpenVINO."""

    def __init__(self, after: nn.Module, inputs: list, state: list[Tensor], threads: int):
        example = [torch.from_numpy(part) for part in inputs] + state
        self.compiled = openvino_cpu.Compiled(after, example, threads)
        self.given = len(inputs)
        self.reset()

    def __call__(self, inputs: list[np.ndarray]) -> np.ndarray:
        """Return what is drawn and keep the state."""
        given = [openvino_cpu.shared(part) for part in inputs]
        self.drawn, *self.state = self.compiled([*given, *self.state])
        return self.drawn.data  # which does not keep the tensor alive

    def reset(self) -> None:
        """Start from zeros."""
        self.state = self.compiled.zeros(self.given)
