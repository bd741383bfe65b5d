"""A network on OpenVINO: compiled for one size of picture, its state handed on without a copy.

Weights and maps are bf16 where the CPU is faster in it and float32 elsewhere (of a wide SetNet one
convolution is in bytes where the CPU has instructions for them); what a network keeps in float32
(`SetNet`: its sums and hidden maps) stays so.  Needs the extra `openvino`.
"""

import sys
import warnings
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.models.eight_bits import drawn_in_bytes
from src.models.explicit_state import Explicit
from src.models.fast import computes_bf16, plain
from src.models.setnet import SetNet

Position = tuple[int, int]


def installed() -> bool:
    """Return whether the package is there."""
    return find_spec("openvino") is not None


def require() -> None:
    """Raise ValueError, saying how to get it, unless the package is there."""
    if not installed():
        raise ValueError("form=openvino needs pip install openvino")


def precision() -> torch.dtype:
    """Return what to compute in here: bfloat16, or float32 on a CPU that is no faster in it."""
    require()
    able = _core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    return torch.bfloat16 if "BF16" in able and computes_bf16() else torch.float32


class Compiled:
    """`module`, compiled for inputs of the sizes and types of `example`, on `threads` threads.

    Inputs and outputs are OpenVINO's tensors; outputs are new ones each time, so that a state that
    was given back stays as it is.  Raises ValueError for a module that OpenVINO cannot express.
    """

    def __init__(self, module: nn.Module, example: Sequence[Tensor], threads: int):
        require()
        model = _converted(module, tuple(example))
        model.reshape({k: list(part.shape) for k, part in enumerate(example)})
        _fold(model)  # bounds of bytes are then constants, without which none are computed in
        options = {
            # What computes in bf16 says so itself: nothing else is rounded.
            "INFERENCE_PRECISION_HINT": "f32",
            "INFERENCE_NUM_THREADS": threads,
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,
        }
        compiled = _core().compile_model(model, "CPU", options)
        self.request = compiled.create_infer_request()
        self.module = module  # whose weights it may read where they lie
        self.outputs = [(part.element_type, list(part.shape)) for part in compiled.outputs]
        self.starts = [(part.element_type, list(part.shape)) for part in compiled.inputs]

    def zeros(self, first: int) -> list:
        """Return zeros for the inputs from the `first` on: the state that comes last."""
        made = [_package().Tensor(kind, shape) for kind, shape in self.starts[first:]]
        for part in made:
            np.asarray(part.data).fill(0)
        return made

    def __call__(self, inputs: Sequence) -> list:
        """Return the outputs; the memory of `inputs` is read, not copied."""
        for k, part in enumerate(inputs):
            self.request.set_input_tensor(k, part)
        outputs = [_package().Tensor(kind, shape) for kind, shape in self.outputs]
        for k, part in enumerate(outputs):
            self.request.set_output_tensor(k, part)
        self.request.infer(share_outputs=True)  # else it copies them all once more
        return outputs


def shared(array: np.ndarray) -> Any:
    """Return a float32 array as OpenVINO's tensor over the same memory."""
    return _package().Tensor(np.ascontiguousarray(array, np.float32), shared_memory=True)


class OpenVinoNetwork(nn.Module):
    """`network`, compiled at its first window of each size with as many threads as torch has then.

    One clip at a time.  Which views and what else it takes are those of `network`.
    """

    def __init__(self, network: nn.Module):
        super().__init__()
        self.dtype = precision()
        # Weights are read in the order in which they lie.
        self.inner = plain(network).to(self.dtype, memory_format=torch.contiguous_format)
        self.views = network.views
        # SetNet adds its events up in float32 and rounds where it convolves.
        self.seen = torch.float32 if isinstance(network, SetNet) else self.dtype
        drawn_in_bytes(self.inner)
        self.made: dict[tuple, tuple[Compiled, bool]] = {}

    @torch.no_grad()
    def forward(
        self,
        voxels: Float[Tensor, "1 views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = 1 / 120,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "1 1 h w"], Any]:
        """Return the frame, float32, and the state: the size it is for and OpenVINO's tensors.

        Raises ValueError for more than one clip, another device than the CPU, or the state of
        another size.
        """
        if voxels.device.type != "cpu" or len(voxels) != 1:
            raise ValueError(
                f"form=openvino takes one clip on device=cpu, got {len(voxels)} on {voxels.device}"
            )
        size = tuple(voxels.shape)
        if state is not None and state[0] != size:
            raise ValueError(f"state must be of voxels {size} for form=openvino, got {state[0]}")
        compiled, timed = self._compiled(voxels, positions)
        seconds = torch.as_tensor(window_s, dtype=torch.float32).reshape(1)
        given = [shared(voxels.numpy())] + ([shared(seconds.numpy())] if timed else [])
        own = compiled.zeros(len(given)) if state is None else state[1]
        frame, *own = compiled([*given, *own])
        return torch.from_numpy(frame.data.copy()), (size, own)

    def _compiled(self, voxels: Tensor, positions) -> tuple[Compiled, bool]:
        """Return what runs windows of this size and whether it is told their length."""
        places = None if positions is None else tuple(tuple(place) for place in positions)
        which = (tuple(voxels.shape), places)
        if which not in self.made:
            explicit = _Rounding(self.inner, places, self.seen)
            state = explicit.begin(voxels.to(self.seen))
            seconds = [torch.full((1,), 1 / 120)] if explicit.timed else []
            example = [voxels.float(), *seconds, *state]
            compiled = Compiled(explicit, example, torch.get_num_threads())
            self.made[which] = compiled, explicit.timed
        return self.made[which]


class _Rounding(Explicit):
    """Takes float32 grids and gives float32 frames, whatever the network computes in."""

    def __init__(self, network: nn.Module, positions, seen: torch.dtype):
        super().__init__(network, positions)
        self.seen = seen

    def forward(self, voxels: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        seconds, state = (rest[0], rest[1:]) if self.timed else (None, rest)
        frame, *after = super().forward(voxels.to(self.seen), seconds, *state)
        return frame.float(), *after


@cache
def _package() -> Any:
    """Return the package, kept from reporting over the network that it was imported: it starts a
    process for that, which is also in the way of what is timed.
    """
    sys.modules.setdefault("openvino_telemetry", None)  # it goes on without it
    import openvino

    return openvino


@cache
def _core() -> Any:
    """Return the one core of this process."""
    return _package().Core()


def _fold(model: Any) -> None:
    """Compute in `model` what does not depend on what it is given."""
    from openvino.passes import ConstantFolding, Manager

    passes = Manager()
    passes.register_pass(ConstantFolding())
    passes.run_passes(model)


def _converted(module: nn.Module, example: tuple[Tensor, ...]) -> Any:
    """Return OpenVINO's model of `module`."""
    from openvino.frontend import FrontEndManager
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder

    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of tracing, about itself
        try:
            frontend = FrontEndManager().load_by_framework("pytorch")
            decoder = TorchScriptPythonDecoder(module.eval(), example_input=example)
            return frontend.convert(frontend.load(decoder))
        except RuntimeError as error:
            kind = type(getattr(module, "network", module)).__name__
            raise ValueError(f"{kind} has a part that OpenVINO cannot express") from error
