"""The forms in which a network runs: float32, bf16, compiled, on OpenVINO."""

import os
import shutil
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from src.deploy.openvino_network import OpenVinoNetwork
from src.models.folding import inference_copy
from src.models.network import WINDOW_S, EventToVideoNetwork
from src.models.setnet import SetNet
from src.sim.optics import Position

NETWORK_FORMS = ("float32", "bf16", "compiled", "openvino")


def convert_to_form(network: EventToVideoNetwork, form: str) -> EventToVideoNetwork:
    """Return `network` in a form to run it in: `float32`, as it is; `bf16`; `compiled`, bf16
    through torch.compile; `openvino`, on OpenVINO, in bf16 where the CPU is faster in it.

    Raises ValueError, naming `form`, for another or where it cannot be made.
    """
    if form not in NETWORK_FORMS:
        raise ValueError(f"form must be one of {', '.join(NETWORK_FORMS)}, got {form}")
    if form == "float32":
        return network
    if not any(True for _ in network.parameters()):
        raise ValueError(f"form must be float32 for a network without parameters, got {form}")
    if form == "openvino":
        return OpenVinoNetwork(network)
    return Bf16Network(network, compiled=form == "compiled")


class Bf16Network(EventToVideoNetwork):
    """A copy of `network` with weights and maps in bf16, channels last; frames are float32.

    `compiled`: by torch.compile, which takes a C++ compiler, minutes at the first windows of
    every size, and as many threads as torch has then.
    """

    def __init__(self, network: EventToVideoNetwork, *, compiled: bool = False):
        super().__init__()
        if compiled and not shutil.which(os.environ.get("CXX", "g++")):
            raise ValueError("form=compiled needs a C++ compiler: g++ or what CXX names")
        self.inner = inference_copy(network).to(torch.bfloat16)
        self.inner.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.views, self.uses_window_length = network.views, network.uses_window_length
        self.compiled, self.input_dtype = compiled, torch.bfloat16
        if isinstance(self.inner, SetNet):  # adds its events up in float32, rounds to convolve
            self.input_dtype = torch.float32
            self.inner.cached_kernels = {}
        if compiled:
            self.inner.compile(dynamic=False)

    @torch.no_grad()
    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        if self.compiled:  # a number would be compiled into the code
            window_s = torch.as_tensor(window_s, dtype=torch.float32)
        seen = voxels.to(self.input_dtype)
        frame, state = self.inner(seen, state, window_s=window_s, positions=positions)
        return frame.float(), state

    def is_settled(self, state: Any) -> bool:
        return self.inner.is_settled(state)

    def advance_without_events(self, state: Any, seconds: float) -> Any:
        return self.inner.advance_without_events(state, seconds)
