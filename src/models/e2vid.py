"""E2VID (Rebecq et al., TPAMI 2019), all of it here, on one or many views.

The paper changes two things: views are stacked as channels (channel = view * bins + bin), and the
gates have spectral normalisation.

Head -> three recurrent encoders (stride 2) -> two residual blocks -> three decoders with skip sums
-> skip sum with the head -> one channel.  10,710,401 parameters with 5 input channels and base 32.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm as normalise_spectrum

from src.models.layers import (
    ConvGRU,
    ConvLSTM,
    ResidualBlock,
    pad_centred_to_multiple,
)
from src.models.network import (
    WINDOW_S,
    EventToVideoNetwork,
    check_state_sizes,
    check_voxel_shape,
    check_window_length,
)
from src.sim.optics import (
    Position,
    check_positions,
    is_arranged_as_layout,
    layout,
    most_central_view_index,
)

CELLS = {"convlstm": ConvLSTM, "convgru": ConvGRU}
ACTIVATIONS = {"sigmoid": torch.sigmoid, "none": lambda x: x}
SCALES = 3


class E2VID(EventToVideoNetwork):
    """Voxel grids of `views` views and `bins` bins to frames, window by window.

    `base_channels`: of the head, doubled at each of three scales.  `stem_channels`: of one more
    convolution before the head, which is 3x3 then, for many views (None: none, as in the paper).
    `state_rounding_step`: outside training the finest cell sees its hidden map, in [-1, 1], in such
    steps, so that nothing creeps on without events (None: as it is, as in the paper).
    `recurrent`: convlstm or convgru.  `kernel_size`: of head, encoders and decoders (published: 5).
    `final_activation`: sigmoid or none.  `spectral_norm`: keep the largest singular value of the
    gate kernels at one (Miyato et al. 2018), computed once within `parametrize.cached()`.  Raises
    ValueError for values outside these.
    """

    views: int

    def __init__(
        self,
        views: int = 1,
        bins: int = 5,
        base_channels: int = 32,
        recurrent: str = "convlstm",
        kernel_size: int = 5,
        final_activation: str = "sigmoid",
        spectral_norm: bool = False,
        stem_channels: int | None = None,
        state_rounding_step: float | None = None,
    ):
        super().__init__()
        step, stem, side, end = state_rounding_step, stem_channels, kernel_size, final_activation
        is_rounding = step is None or (0 < step <= 1 and recurrent == "convlstm")
        rounding = "in (0, 1], with model.recurrent=convlstm, or null"
        for name, value, is_valid, allowed in (
            ("recurrent", recurrent, recurrent in CELLS, f"one of {', '.join(CELLS)}"),
            ("final_activation", end, end in ACTIVATIONS, f"one of {', '.join(ACTIVATIONS)}"),
            ("kernel_size", side, side >= 1 and side % 2 == 1, "odd and >= 1"),
            ("stem_channels", stem, stem is None or stem >= 1, ">= 1 or null"),
            ("state_rounding_step", f"{step} with {recurrent}", is_rounding, rounding),
        ):
            if not is_valid:
                raise ValueError(f"model.{name} must be {allowed}, got {value}")
        self.views, self.bins, self.activation = views, bins, ACTIVATIONS[final_activation]
        self.state_rounding_step = state_rounding_step
        widths = [base_channels * 2**scale for scale in range(SCALES + 1)]
        pairs = list(pairwise(widths))
        self.stem = _conv(views * bins, stem_channels, kernel_size) if stem_channels else None
        seen, side = (stem_channels, 3) if stem_channels else (views * bins, kernel_size)
        self.head = _conv(seen, base_channels, side)
        self.encoders = nn.ModuleList(_conv(a, b, kernel_size, stride=2) for a, b in pairs)
        self.cells = nn.ModuleList(CELLS[recurrent](width) for width in widths[1:])
        self.resblocks = nn.Sequential(*(ResidualBlock(widths[-1]) for _ in range(2)))
        self.decoders = nn.ModuleList(_conv(b, a, kernel_size) for a, b in reversed(pairs))
        self.pred = nn.Conv2d(base_channels, 1, 1)
        self.relu = nn.ReLU()
        if spectral_norm:
            for gate in self.gates:
                normalise_spectrum(gate)

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame at the end of the window and the state, one entry per scale.

        Views are in the order of `layout`.  `window_s` and `positions` change nothing.  Raises
        ValueError for another shape, for positions of another number or order, and when
        views, bins, the window's length or the sizes of the state do not fit.
        """
        x, (top, left) = self._padded(voxels, window_s, positions)
        self._check_state(state, x)
        height, width = voxels.shape[-2:]
        frame, after = self.after_first_layer(self.first_layer(x), state)
        return frame[..., top : top + height, left : left + width], after

    def warm_up(self, voxels: Tensor, state: Any = None, **options: Any) -> tuple:
        """Return the state that `forward` does, without its decoder; ValueError as there."""
        x, _ = self._padded(voxels, **options)
        self._check_state(state, x)
        return self.encode(self.first_layer(x), state)[2]

    def check_positions(self, positions: Sequence[Position]) -> None:
        """Raise ValueError unless `positions` are (row, col), one for each view, that stand to each
        other as in `layout`.
        """
        self._check_number(positions)
        if not is_arranged_as_layout(positions):
            wanted = f"arranged as {list(layout(self.views))} for this network"
            raise ValueError(f"positions must be {wanted}, got {list(positions)}")

    def _check_number(self, positions: Sequence[Position]) -> None:
        check_positions(positions, self.views)

    def _check_order(self, positions: Sequence[Position]) -> None:
        """Raise ValueError for another number of views, and for those of `layout` in another order:
        others may be what the network was trained with.
        """
        self._check_number(positions)
        if is_arranged_as_layout(positions):
            return
        if is_arranged_as_layout(sorted((int(row), int(col)) for row, col in positions)):
            wanted = f"in the order {list(layout(self.views))} for this network"
            raise ValueError(f"positions must be {wanted}, got {list(positions)}")

    def _padded(
        self,
        voxels: Tensor,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Tensor, tuple[int, int]]:
        check_voxel_shape(voxels)
        if tuple(voxels.shape[1:3]) != (self.views, self.bins):
            wanted, got = (self.views, self.bins), tuple(voxels.shape[1:3])
            where = "for this network (in commands: optics.views, bins)"
            raise ValueError(f"views, bins must be {wanted} {where}, got {got}")
        check_window_length(window_s)
        if positions is not None:
            self._check_order(positions)
        stacked = voxels.flatten(1, 2).to(self.first_layer.weight.dtype)
        return pad_centred_to_multiple(stacked, 2**SCALES)

    def _check_state(self, state: Any, x: Float[Tensor, "n c h w"]) -> None:
        """Raise ValueError unless `state` has the sizes that padded voxels `x` leave."""
        if not state:
            return
        check_state_sizes(state, self.state_sizes(x))

    def state_sizes(self, x: Float[Tensor, "n c h w"]) -> list[tuple[int, ...]]:
        """Return the sizes of the state's tensors, in order, that padded voxels `x` leave."""
        n, _, height, width = x.shape
        sizes: list[tuple[int, ...]] = []
        for scale, cell in enumerate(self.cells, start=1):
            channels = self.encoders[scale - 1].out_channels
            size: tuple[Any, ...] = n, channels, height // 2**scale, width // 2**scale
            sizes += [size] * (2 if isinstance(cell, ConvLSTM) else 1)
        return sizes

    @property
    def gates(self) -> list[nn.Conv2d]:
        """The convolutions of the cells, whose kernels `spectral_norm` keeps at norm one."""
        return [gate for cell in self.cells for gate in cell.children()]  # type: ignore[misc]

    @property
    def first_layer(self) -> nn.Conv2d:
        """The layer that sees the grids."""
        return self.head if self.stem is None else self.stem

    def widen_state_dict(self, weights: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return `weights` of the same network on one view, for this one: the first layer sees the
        centre view as before and the others not yet, so that the frames are one view's.
        """
        first = "head.weight" if self.stem is None else "stem.weight"
        before = most_central_view_index(layout(self.views)) * self.bins
        behind = (self.views - 1) * self.bins - before
        padding = (0, 0, 0, 0, before, behind)
        return {n: functional.pad(w, padding) if n == first else w for n, w in weights.items()}

    def after_first_layer(
        self, x: Float[Tensor, "n c h w"], state: Any
    ) -> tuple[Float[Tensor, "n 1 h w"], tuple]:
        """Return the frame, padding and all, and the state; `x` is the first layer's, no ReLU."""
        head, skips, after = self.encode(x, state)
        return self.activation(self.decode_logits(self.resblocks(skips[-1]), head, skips)), after

    def encode(
        self, x: Float[Tensor, "n c h w"], state: Any
    ) -> tuple[Float[Tensor, "n c2 h w"], list[Tensor], tuple]:
        """Return the head, the hidden map of each scale, finest first, and the state."""
        head = x = self.relu(x if self.stem is None else self.head(self.relu(x)))
        skips, after, states = [], [], list(state or [None] * SCALES)
        step = self.state_rounding_step
        if state and step and not self.training:
            hidden, memory = states[0]
            states[0] = (hidden / step).round() * step, memory
        for encoder, cell, before in zip(self.encoders, self.cells, states, strict=True):
            x, new = cell(self.relu(encoder(x)), before)
            skips.append(x)
            after.append(new)
        return head, skips, tuple(after)

    def decode_logits(
        self, x: Float[Tensor, "n c h w"], head: Float[Tensor, "n c2 h2 w2"], skips: list[Tensor]
    ) -> Float[Tensor, "n 1 h2 w2"]:
        """Return the frame before its activation, from the coarsest map up."""
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = functional.interpolate(x + skip, scale_factor=2, mode="bilinear")
            x = self.relu(decoder(x))
        return self.pred(x + head)


def _conv(inputs: int, outputs: int, kernel_size: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, kernel_size, stride, padding=kernel_size // 2)
