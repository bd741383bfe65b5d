"""A network as an ONNX file with its state as explicit inputs and outputs, and back to run it.

A file is for one number of views, one size of picture and one clip at a time; the length of a
window is an input.  Needs the extra `onnx`: pip install onnx onnxruntime onnxscript.
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.models.explicit_state import Explicit
from src.models.fast import plain
from src.models.unroll import takes

NEEDED = ("onnx", "onnxscript", "onnxruntime")
TOLERANCE = 1e-4  # largest difference from PyTorch, in grey levels, that an export may show
CHECKED = 4  # windows over which it is compared


def export(
    network: nn.Module,
    path: Path,
    *,
    views: int,
    height: int,
    width: int,
    bins: int = 5,
    positions: Sequence[tuple[int, int]] | None = None,
) -> "OnnxNetwork":
    """Write `network` to `path`, spectral norm folded; return what runs it, checked against it.

    Raises ValueError without the packages, for a network that ONNX cannot express, and where the
    two differ by more than TOLERANCE over a few windows of noise.
    """
    require()
    folded = plain(network).cpu()
    voxels = torch.randn(1, views, bins, height, width, generator=torch.Generator().manual_seed(0))
    explicit = Explicit(folded, positions)
    with torch.no_grad():
        started = explicit.begin(voxels)
        _write(explicit, (voxels, torch.full((1,), 1 / 120), *started), path)
    exported = OnnxNetwork(path)
    gap = _gap(exported, folded, voxels, positions)
    if not gap <= TOLERANCE:
        raise ValueError(f"export must give PyTorch's frames within {TOLERANCE}, got {gap:.2g}")
    return exported


def require() -> None:
    """Raise ValueError, saying how to get them, unless the packages are there."""
    absent = [name for name in NEEDED if find_spec(name) is None]
    if absent:
        raise ValueError(f"ONNX needs pip install {' '.join(absent)}")


class OnnxNetwork(nn.Module):
    """The network of a file written by `export`, on ONNX Runtime with `threads` threads."""

    views = None

    def __init__(self, path: Path, threads: int = 1):
        require()
        import onnxruntime

        super().__init__()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        providers = ["CPUExecutionProvider"]
        self.session = onnxruntime.InferenceSession(str(path), options, providers)
        self.inputs = {node.name: node.shape for node in self.session.get_inputs()}

    def forward(
        self,
        voxels: Float[Tensor, "1 views bins h w"],
        state: list | None = None,
        *,
        window_s: float = 1 / 120,
    ) -> tuple[Float[Tensor, "1 1 h w"], list]:
        """Return the frame and the state, arrays in the file's order; None starts from zeros."""
        names = [name for name in self.inputs if name.startswith("state")]
        if state is None:
            state = [torch.zeros(self.inputs[name]).numpy() for name in names]
        fed = {"voxels": voxels.numpy(), **dict(zip(names, state, strict=True))}
        if "window_s" in self.inputs:
            fed["window_s"] = torch.full((1,), window_s).numpy()
        frame, *after = self.session.run(None, fed)
        return torch.from_numpy(frame), after


def _write(explicit: Explicit, example: tuple, path: Path) -> None:
    states = range(len(example) - 2)
    names = ["voxels", "window_s", *(f"state{k}" for k in states)]
    chatty = logging.getLogger("torch.onnx")
    level = chatty.level
    chatty.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")  # of the exporter's own parts about each other
            torch.onnx.export(
                explicit, example, str(path), dynamo=True, input_names=names, verbose=False,
                output_names=["frame", *(f"after{k}" for k in states)], external_data=False,
            )  # fmt: skip
    except torch.onnx.OnnxExporterError as error:
        kind = type(explicit.network).__name__
        raise ValueError(f"{kind} has a part that ONNX cannot express") from error
    finally:
        chatty.setLevel(level)


@torch.no_grad()
def _gap(exported: OnnxNetwork, folded: nn.Module, voxels: Tensor, positions) -> float:
    options = {"positions": positions} if takes(folded, "positions") else {}
    ours, theirs, gap = None, None, 0.0
    for k in range(CHECKED):
        shown = voxels.roll(3 * k, -1)
        frame, ours = folded(shown, ours, **options)
        other, theirs = exported(shown, theirs)
        gap = max(gap, float((frame - other).abs().max()))
    return gap
