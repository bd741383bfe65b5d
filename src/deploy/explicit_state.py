"""A network whose state is a flat list of tensors, as what runs outside PyTorch wants it."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from src.models.network import EventToVideoNetwork
from src.sim.optics import Position


class ExplicitStateNetwork(nn.Module):
    """`network` with its state as explicit inputs and outputs, for one clip at a time.

    Voxels are converted to `input_dtype`, frames to float32.
    """

    def __init__(
        self,
        network: EventToVideoNetwork,
        positions: Sequence[Position] | None,
        input_dtype: torch.dtype = torch.float32,
    ):
        super().__init__()
        self.network, self.positions, self.input_dtype = network, positions, input_dtype

    def initial_state(self, voxels: Tensor) -> list[Tensor]:
        """Return the state before the first window, zeros, and note its structure."""
        voxels = voxels.to(self.input_dtype)
        _, state = self.network(voxels, None, positions=self.positions)
        leaves, self.structure = pytree.tree_flatten(state)
        return [torch.zeros_like(leaf) for leaf in leaves]

    def forward(self, voxels: Tensor, window_s: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Return the frame and the tensors of the new state; `window_s` (1,) is in seconds."""
        before = pytree.tree_unflatten(state, self.structure)
        voxels = voxels.to(self.input_dtype)
        frame, after = self.network(voxels, before, window_s=window_s, positions=self.positions)
        return frame.float(), *pytree.tree_leaves(after)
