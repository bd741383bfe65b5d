"""A network on OpenVINO: compiled for one size of picture, its state handed on without a copy.

Weights and maps are bf16 where the CPU is faster in it and float32 elsewhere (of a wide SetNet one
convolution is in bytes where the CPU has instructions for them); what a network keeps in float32
(`SetNet`: its sums and hidden maps) stays so.  Needs the extra `openvino`.
"""

import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.deploy.cpu_features import is_bf16_faster
from src.deploy.explicit_state import ExplicitStateNetwork
from src.deploy.int8 import quantise_decoder_conv
from src.models.folding import inference_copy
from src.models.network import WINDOW_S, EventToVideoNetwork
from src.models.setnet import SetNet
from src.sim.optics import Position

# The package would report over the network that it was imported, in a process of its own; it goes
# on without.  Before torch.compile, which imports it too.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]


def is_installed() -> bool:
    """Return whether the package is there."""
    return find_spec("openvino") is not None


def fastest_dtype() -> torch.dtype:
    """Return what to compute in here: bfloat16, or float32 on a CPU that is no faster in it.

    Raises ValueError, saying how to get it, without the package.
    """
    if not is_installed():
        raise ValueError("form=openvino needs pip install openvino")
    able = _core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    return torch.bfloat16 if "BF16" in able and is_bf16_faster() else torch.float32


class CompiledModule:
    """`module`, compiled for inputs of the sizes and types of `example`, on `threads` threads.

    The state, OpenVINO's tensors, is the last inputs and outputs; it is new each time, so that one
    that was given back stays as it is.  Raises ValueError for what OpenVINO cannot express.
    """

    def __init__(self, module: nn.Module, example: Sequence[Tensor], threads: int):
        graph = _trace(module, tuple(example))
        model = _convert(module, graph, example)
        options = {
            # What computes in bf16 says so itself: nothing else is rounded.
            "INFERENCE_PRECISION_HINT": "f32",
            "INFERENCE_NUM_THREADS": threads,
            "PERFORMANCE_HINT": "LATENCY",
            "ENABLE_CPU_PINNING": False,
        }
        compiled = _core().compile_model(model, "CPU", options)
        self.request = compiled.create_infer_request()
        self.bound: list[list[np.ndarray]] = []
        self.weights = module, graph  # which it may read where they lie
        self.outputs = [(part.element_type, list(part.shape)) for part in compiled.outputs]
        self.starts = [(part.element_type, list(part.shape)) for part in compiled.inputs]

    def zeros(self, first: int) -> list:
        """Return zeros for the inputs from the `first` on: the state that comes last."""
        made = [_package().Tensor(kind, shape) for kind, shape in self.starts[first:]]
        for part in made:
            np.asarray(part.data).fill(0)
        return made

    def __call__(self, inputs: Sequence[np.ndarray], state: Sequence) -> list:
        """Return the first output, valid until the next call, and the state; nothing is copied."""
        arrays = [np.ascontiguousarray(part, np.float32) for part in inputs]
        outputs = [_package().Tensor(kind, shape) for kind, shape in self.outputs]
        self._bind([*map(_share, arrays), *state], outputs)
        self.request.infer(share_outputs=True)  # else it copies them all once more
        self.output, *state = outputs  # an array does not keep its tensor alive
        return [self.output.data, *state]

    def run(self, inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
        """Write the outputs of a module that takes no state: arrays, contiguous and float32."""
        if not (self.bound and self.bound[0] is inputs and self.bound[1] is outputs):
            self._bind(map(_share, inputs), map(_share, outputs))
            self.bound = [inputs, outputs]
        self.request.infer(share_outputs=True)

    def _bind(self, inputs: Iterable, outputs: Iterable) -> None:
        for k, part in enumerate(inputs):
            self.request.set_input_tensor(k, part)
        for k, part in enumerate(outputs):
            self.request.set_output_tensor(k, part)


class OpenVinoNetwork(EventToVideoNetwork):
    """`network`, compiled at its first window of each size with as many threads as torch has then.

    One clip at a time.
    """

    def __init__(self, network: EventToVideoNetwork):
        super().__init__()
        dtype = fastest_dtype()
        # Weights are read in the order in which they lie.
        self.inner = inference_copy(network).to(dtype)
        self.inner.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        self.views, self.uses_window_length = network.views, network.uses_window_length
        # SetNet adds its events up in float32 and rounds where it convolves.
        self.input_dtype = torch.float32 if isinstance(network, SetNet) else dtype
        quantise_decoder_conv(self.inner)
        self.compiled: dict[tuple, CompiledModule] = {}

    @torch.no_grad()
    def forward(
        self,
        voxels: Float[Tensor, "1 views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "1 1 h w"], Any]:
        """Return the frame, float32, and the state: the size it is for and OpenVINO's tensors.

        Raises ValueError for more than one clip, another device than the CPU, or the state of
        another size.
        """
        if voxels.device.type != "cpu" or len(voxels) != 1:
            got = f"{len(voxels)} on {voxels.device}"
            raise ValueError(f"form=openvino takes one clip on device=cpu, got {got}")
        size = tuple(voxels.shape)
        if state is not None and state[0] != size:
            raise ValueError(f"state must be of voxels {size} for form=openvino, got {state[0]}")
        compiled = self._compiled(voxels, positions)
        given = voxels.numpy(), np.float32(window_s).reshape(1)
        frame, *own = compiled(given, compiled.zeros(len(given)) if state is None else state[1])
        return torch.from_numpy(frame.copy()), (size, own)

    def _compiled(self, voxels: Tensor, positions: Sequence[Position] | None) -> CompiledModule:
        places = None if positions is None else tuple((row, column) for row, column in positions)
        which = (tuple(voxels.shape), places)
        if which not in self.compiled:
            explicit = ExplicitStateNetwork(self.inner, places, self.input_dtype)
            state = explicit.initial_state(voxels)
            example = [voxels.float(), torch.full((1,), WINDOW_S), *state]
            self.compiled[which] = CompiledModule(explicit, example, torch.get_num_threads())
        return self.compiled[which]


def _package() -> Any:
    import openvino

    return openvino


@cache
def _core() -> Any:
    return _package().Core()


def _share(array: np.ndarray) -> Any:
    return _package().Tensor(array, shared_memory=True)


def _trace(module: nn.Module, example: tuple[Tensor, ...]) -> Any:
    """Return the graph of `module`, its weights constants.

    One of `torch.jit.trace` would stay in memory for good.
    """
    with warnings.catch_warnings(), torch.no_grad(), _explained(module):
        warnings.simplefilter("ignore")  # of tracing, about itself
        module.eval().requires_grad_(False)
        # Tensors of a function are constants of the graph, those of a module would be inputs.
        return torch.jit._get_trace_graph(lambda *given: module(*given), example, strict=False)[0]


def _convert(module: nn.Module, graph: Any, example: Sequence[Tensor]) -> Any:
    """Return OpenVINO's model of a `graph`, what does not depend on its inputs computed.

    A model of `openvino.convert_model` takes 15 to 30 % longer.
    """
    from openvino.frontend import FrontEndManager
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder
    from openvino.passes import ConstantFolding, Manager

    with _explained(module):
        frontend = FrontEndManager().load_by_framework("pytorch")
        decoder = TorchScriptPythonDecoder(module, graph, alias_db=graph.alias_db())
        model = frontend.convert(frontend.load(decoder))
    model.reshape({k: list(part.shape) for k, part in enumerate(example)})
    passes = Manager()  # bounds of bytes are then constants, without which none are computed in
    passes.register_pass(ConstantFolding())
    passes.run_passes(model)
    return model


@contextmanager
def _explained(module: nn.Module) -> Iterator[None]:
    """Raise ValueError, which names `module`, for an error of tracing or of OpenVINO."""
    try:
        yield
    except Exception as error:
        if "KeyboardInterrupt" in str(error):  # OpenVINO makes another error of Ctrl-C
            raise KeyboardInterrupt from error
        kind = type(getattr(module, "network", module)).__name__
        raise ValueError(f"{kind} has a part that OpenVINO cannot express") from error
