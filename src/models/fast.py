"""A network made for running only: bf16, channels-last, folded, compiled, idle without events."""

import os
import shutil
import time
from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import parametrize

from src.models.files import fold
from src.models.setnet import SetNet
from src.models.unroll import takes

FORMS = ("float32", "bf16", "compiled", "openvino")
TRIED = 20  # convolutions of a kind, the first of which are slow


@cache
def computes_bf16() -> bool:
    """Return whether this processor is faster in bf16 than in float32, by a convolution in each.

    Without instructions for it bf16 takes many times longer.  With them it takes half the time or,
    on Intel's processors whose matrix unit (AMX) a virtual machine hides, twice as long.
    """
    has = _says("avx512_bf16", "amx_bf16", "bf16")
    return has and convolution_s(torch.bfloat16) < convolution_s(torch.float32)


def computes_bytes() -> bool:
    """Return whether this processor has instructions that multiply bytes and add them up."""
    return _says("avx512_vnni", "avx_vnni")


def _says(*names: str) -> bool:
    """Return whether this processor says that it can do one of `names`."""
    able = torch.cpu.get_capabilities()
    return any(able.get(name) for name in names)


def convolution_s(kind: torch.dtype) -> float:
    """Return what a convolution of 85 MMAC, channels last, takes in `kind`, seconds: the shortest
    of some."""
    maps = torch.ones(1, 64, 48, 48, dtype=kind).to(memory_format=torch.channels_last)
    kernel = torch.ones(64, 64, 3, 3, dtype=kind).to(memory_format=torch.channels_last)
    taken = []
    with torch.inference_mode():
        for _ in range(TRIED):
            start = time.perf_counter()
            functional.conv2d(maps, kernel, padding=1)
            taken.append(time.perf_counter() - start)
    return min(taken)


def running(network: nn.Module, form: str) -> nn.Module:
    """Return `network` in a form to run it in: `float32`, as it is; `bf16`, a Fast one; `compiled`,
    that one compiled; `openvino`, on OpenVINO, in bf16 where the CPU is faster in it.

    Raises ValueError, naming `form`, for another or where it cannot be made.
    """
    if form not in FORMS:
        raise ValueError(f"form must be one of {', '.join(FORMS)}, got {form}")
    if form == "float32":
        return network
    if not any(True for _ in network.parameters()):
        raise ValueError(f"form must be float32 for a network without parameters, got {form}")
    if form == "openvino":
        from src.models.openvino_cpu import OpenVinoNetwork  # which takes `plain` from here

        return OpenVinoNetwork(network)
    return Fast(network, skip_empty=False, compiled=form == "compiled")


class Fast(nn.Module):
    """`network`, copied, with weights and maps of `dtype` and laid out channels-last.

    `skip_empty`: a window without any event gives the last frame again and leaves the state.
    `compiled`: torch.compile makes one pass of what lies between two convolutions, which takes a
    C++ compiler, half a minute at the first windows of every size, and as many threads as torch has
    then.  Which views and what else it takes are those of `network`; frames are float32.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        dtype: torch.dtype = torch.bfloat16,
        skip_empty: bool = True,
        compiled: bool = False,
    ):
        super().__init__()
        if compiled and not shutil.which(os.environ.get("CXX", "g++")):
            raise ValueError("form=compiled needs a C++ compiler: g++ or what CXX names")
        self.inner = plain(network).to(dtype=dtype, memory_format=torch.channels_last)
        self.views, self.dtype, self.skip_empty = network.views, dtype, skip_empty
        # SetNet adds its events up in float32 and rounds where it convolves.
        self.rounds_itself = isinstance(network, SetNet)
        if self.rounds_itself:
            self.inner.frozen = {}
        self.compiled = compiled
        if compiled:
            self.inner.compile(dynamic=False)
        self.options = [name for name in ("window_s", "positions") if takes(network, name)]

    @torch.no_grad()
    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = 1 / 120,
        positions: Sequence[tuple[int, int]] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame and the state (the network's own, last frame)."""
        if self.skip_empty and state is not None and _silent(voxels):
            return state[1], state
        if self.compiled:  # a number would be compiled into the code
            window_s = torch.as_tensor(window_s, dtype=torch.float32)
        facts = {"window_s": window_s, "positions": positions}
        options = {name: facts[name] for name in self.options}
        own = None if state is None else state[0]
        seen = voxels if self.rounds_itself else voxels.to(self.dtype)
        frame, own = self.inner(seen, own, **options)
        frame = frame.float()
        return frame, (own, frame)


def _silent(voxels: Tensor) -> bool:
    """Return whether there is no event; plane by plane, as the first one mostly has some."""
    planes = voxels.flatten(0, 2) if voxels.device.type == "cpu" else [voxels]
    return not any(planes[i].any() for i in range(len(planes)))


def plain(network: nn.Module) -> nn.Module:
    """Return a copy of `network` for running only, its parametrisations folded."""
    copied = deepcopy(network).eval().requires_grad_(False)
    for module in copied.modules():
        if parametrize.is_parametrized(module):
            # A copy shares its class, of which folding takes the weight's property, with the
            # original.
            kind = type(module)
            own = {k: v for k, v in vars(kind).items() if k not in ("__dict__", "__weakref__")}
            module.__class__ = type(kind.__name__, kind.__bases__, own)
    fold(copied)
    return copied
