"""A network as an ONNX file with its state as explicit inputs and outputs, and back to run it.

Needs the extra `onnx`: pip install onnx onnxruntime onnxscript.
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils import _pytree as pytree

from src.deploy.explicit_state import ExplicitStateNetwork
from src.deploy.picture_size import check_picture_size
from src.models.folding import inference_copy
from src.models.network import WINDOW_S, EventToVideoNetwork, check_state_sizes
from src.records.atomic import atomic_path
from src.sim.optics import Position

PACKAGES = ("onnx", "onnxscript", "onnxruntime")
TOLERANCE = 1e-4  # from PyTorch: of frames, in grey levels, and of states, whose values may be > 1
USES_WINDOW_LENGTH = "uses_window_length"  # a fact in the file
CHECKED_WINDOWS = 4  # windows over which it is compared


def export_onnx(
    network: EventToVideoNetwork, path: Path | str, *, views: int, height: int, width: int,
    bins: int = 5, positions: Sequence[Position] | None = None,
) -> "OnnxNetwork":  # fmt: skip
    """Write `network` to `path`, spectral norm folded; return what runs it, checked against it.

    The file takes `views` views of `bins` bins at `positions` (row, col; None: `layout`), pictures
    of `height` x `width` pixels and one clip at a time.  Inputs, float32: `voxels` (1, views, bins,
    h, w), `window_s` (1,) in seconds, where the network uses it, and `state0`, `state1`, ..., zeros
    for the first window; outputs: `frame` (1, 1, h, w) and `after0`, `after1`, ..., the states for
    the next.

    In each of a few windows of noise both begin with PyTorch's state.  Raises ValueError without
    the packages, for sides below 8, for a network that ONNX cannot express or its runtime not run,
    and where frames differ by more than TOLERANCE or states by that share of their largest value,
    as PIE-Net's do; then `path` is as it was.
    """
    require_onnx()
    check_picture_size(height, width)
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"path must be in a folder that is there, got {path}")
    folded = inference_copy(network).cpu()
    voxels = torch.randn(1, views, bins, height, width, generator=torch.Generator().manual_seed(0))
    explicit = ExplicitStateNetwork(folded, positions)
    with torch.no_grad():
        started = explicit.initial_state(voxels)
    with atomic_path(path) as partial:
        _write(explicit, (voxels, torch.full((1,), WINDOW_S), *started), partial)
        exported = _open_written(partial, type(folded).__name__)
        gap = _largest_difference(exported, folded, voxels, positions)
        if not gap <= TOLERANCE:
            wanted = f"PyTorch's frames and states within {TOLERANCE}"
            raise ValueError(f"export must give {wanted}, got {gap:.2g}")
    return exported


def _open_written(path: Path, kind: str) -> "OnnxNetwork":
    try:
        return OnnxNetwork(path)
    except Exception as error:  # ONNX Runtime raises all kinds
        why = " ".join(str(error).split())
        raise ValueError(f"{kind} has a part that ONNX Runtime cannot run: {why}") from error


def require_onnx() -> None:
    """Raise ValueError, saying how to get them, unless the packages are there."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise ValueError(f"ONNX needs pip install {' '.join(missing)}")


class OnnxNetwork(EventToVideoNetwork):
    """The network of a file written by `export_onnx`, on ONNX Runtime with `threads` threads.

    Raises ValueError without the packages and, called, for voxels of another size or type.
    """

    def __init__(self, path: Path | str, threads: int = 1):
        require_onnx()
        import onnxruntime

        super().__init__()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        providers = ["CPUExecutionProvider"]
        self.session = onnxruntime.InferenceSession(str(path), options, providers)
        self.inputs = {node.name: node.shape for node in self.session.get_inputs()}
        self.views = self.inputs["voxels"][1]
        facts = self.session.get_modelmeta().custom_metadata_map
        self.uses_window_length = facts.get(USES_WINDOW_LENGTH, "True") == "True"

    def forward(
        self,
        voxels: Float[Tensor, "1 views bins h w"],
        state: list | None = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "1 1 h w"], list]:
        """Return the frame and the state, arrays; `positions` are those of the export."""
        if list(voxels.shape) != self.inputs["voxels"] or voxels.dtype != torch.float32:
            wanted, got = self.inputs["voxels"], f"{voxels.dtype} {list(voxels.shape)}"
            raise ValueError(f"voxels must be float32 {wanted}, as exported, got {got}")
        names = [name for name in self.inputs if name.startswith("state")]
        if state is None:
            state = [torch.zeros(self.inputs[name]).numpy() for name in names]
        check_state_sizes(state, [tuple(self.inputs[name]) for name in names])
        fed = {"voxels": voxels.numpy(), **dict(zip(names, state, strict=True))}
        if "window_s" in self.inputs:
            fed["window_s"] = torch.as_tensor(window_s, dtype=torch.float32).reshape(1).numpy()
        frame, *after = self.session.run(None, fed)
        return torch.from_numpy(frame), after


@torch.no_grad()
def _write(explicit: ExplicitStateNetwork, example: tuple, path: Path) -> None:
    states = range(len(example) - 2)
    names = ["voxels", "window_s", *(f"state{k}" for k in states)]
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")  # of the exporter's own parts about each other
            program = torch.onnx.export(
                explicit, example, dynamo=True, input_names=names, verbose=False,
                output_names=["frame", *(f"after{k}" for k in states)],
            )  # fmt: skip
            assert program is not None
            program.model.metadata_props[USES_WINDOW_LENGTH] = str(
                explicit.network.uses_window_length
            )
            program.save(path, external_data=False)
    except torch.onnx.OnnxExporterError as error:
        kind = type(explicit.network).__name__
        raise ValueError(f"{kind} has a part that ONNX cannot express") from error
    finally:
        logger.setLevel(level)


@torch.no_grad()
def _largest_difference(
    exported: EventToVideoNetwork, folded: EventToVideoNetwork, voxels: Tensor, positions
) -> float:
    """Return that of frames and states; a step of an E2VID's rounded state that falls otherwise for
    a difference in the last bit has no part in it, as each window begins with the same state."""
    ours, theirs, gaps = None, None, []
    for k in range(CHECKED_WINDOWS):
        window = voxels.roll(3 * k, -1)
        other, others = exported(window, theirs)
        frame, ours = folded(window, ours, positions=positions)
        leaves = pytree.tree_leaves(ours)
        theirs = [leaf.numpy() for leaf in leaves]
        gaps.append(float((frame - other).abs().max()))
        gaps += [_difference(*pair) for pair in zip(leaves, others, strict=True)]
    return float(np.max(gaps))  # nan where one is


def _difference(ours: Tensor, theirs: np.ndarray) -> float:
    """Return the largest one, as a share of the largest value where that is above 1."""
    largest = max(1.0, float(ours.abs().max()))
    return float((ours - torch.from_numpy(theirs)).abs().max()) / largest
