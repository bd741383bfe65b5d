"""The layers of an E2VID behind its first one, for one clip: a map in, frame and state out.

The map comes channels last, as events are added to it; `kernel`, `bias`, `stride` and `views` say
what the first layer is.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from src.models.e2vid import E2VID
from src.sim.optics import Position


class E2VIDRemainder(nn.Module):
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
        self.views, self.stride = network.views, 1
        self.kernel, self.bias = (part.float().numpy() for part in network.first_layer.parameters())
        self.network, self.dtype = network.to(dtype), dtype
        with torch.no_grad():
            head = self._to_first(torch.zeros(1, *padded, len(self.kernel)))
            leaves, self.structure = pytree.tree_flatten(
                self.network.after_first_layer(head, None)[1]
            )
        self.initial_state = [torch.zeros_like(leaf) for leaf in leaves]

    def forward(self, head: Float[Tensor, "1 h w c"], *state: Tensor) -> tuple[Tensor, ...]:
        """Return the frame (1, 1, h, w), float32, and the tensors of the state."""
        before = pytree.tree_unflatten(state, self.structure)
        frame, after = self.network.after_first_layer(self._to_first(head), before)
        return frame.float(), *pytree.tree_leaves(after)

    def _to_first(self, head: Tensor) -> Tensor:
        return channels_first(head).to(self.dtype)


def channels_first(x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n c h w"]:
    """Return a view of `x`."""
    return x.permute(0, 3, 1, 2)
