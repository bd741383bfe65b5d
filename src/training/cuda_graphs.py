"""A training sequence as CUDA graphs: one launch forward, one backward, instead of thousands."""

from collections.abc import Callable, Sequence
from threading import Lock
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import parametrize

from src.models.network import EventToVideoNetwork, unroll

MAX_GRAPHS = 24
CAPTURE_LOCK = Lock()  # held during a capture, which fails where another thread uses the device
TOLERANCE = 0.005  # mean difference of frames in [0, 1], above which a graph is not used


class UnrolledNetwork(nn.Module):
    """A network over a sequence from no state; its frames of the windows `output_windows`."""

    def __init__(self, network: EventToVideoNetwork, positions: Sequence | None, outputs: Sequence):
        super().__init__()
        self.network, self.positions, self.output_windows = network, positions, outputs

    def forward(self, voxels: Tensor, window_s: Tensor) -> Float[Tensor, "n outputs 1 h w"]:
        """Return the frames; voxels (n, windows, views, bins, h, w), window_s (n,)."""
        with parametrize.cached():
            return unroll(
                self.network, voxels,
                window_s=window_s, positions=self.positions, output_windows=self.output_windows,
            )[0]  # fmt: skip


class GraphedUnroll:
    """Unrolls `network` over batches on a GPU: the first batch of each size and each selection of
    output windows operator by operator, those that follow as a CUDA graph.

    At most MAX_GRAPHS are made, all of one pool of memory.  The first time that a graph cannot be
    made, runs out of memory or gives other frames, one line is printed and no more are made.
    """

    def __init__(self, network: EventToVideoNetwork):
        self.network = network
        self.seen: set[tuple] = set()
        self.graphs: dict[tuple, Callable] = {}
        self.pool: Any = None
        self.max_graphs = MAX_GRAPHS

    def __call__(
        self, voxels: Tensor, window_s: Tensor, positions: Sequence | None, outputs: Sequence[int]
    ) -> Float[Tensor, "n outputs 1 h w"]:
        """Return the frames of the windows `outputs`; arguments as those of UnrolledNetwork."""
        places = None if positions is None else tuple(map(tuple, positions))
        name = (tuple(voxels.shape), voxels.dtype, places, tuple(outputs))
        if name in self.graphs:
            return self.graphs[name](voxels, window_s)
        plain = UnrolledNetwork(self.network, positions, outputs)
        if name not in self.seen or len(self.graphs) >= self.max_graphs:
            self.seen.add(name)
            return plain(voxels, window_s)
        try:
            with CAPTURE_LOCK:
                graph = self._capture(plain, voxels, window_s)
        except Exception as error:  # whatever a driver, a kernel or the memory says
            self.max_graphs = len(self.graphs)
            torch.cuda.empty_cache()
            made, why = self.max_graphs or "none", " ".join(str(error).split())
            print(f"cuda_graphs: {made}, other batches operator by operator: {why}")
            return plain(voxels, window_s)
        self.graphs[name] = graph
        return graph(voxels, window_s)

    def _capture(self, plain: UnrolledNetwork, voxels: Tensor, window_s: Tensor) -> Callable:
        """Return `plain` as a graph; RuntimeError where its frames are not those of `plain`."""
        if self.pool is None:
            self.pool = torch.cuda.graph_pool_handle()
        kind = torch.get_autocast_dtype("cuda")
        half = torch.is_autocast_enabled("cuda")
        # Inside a graph nothing may be kept from one replay to the next, casts of weights neither.
        with torch.autocast("cuda", kind, enabled=half, cache_enabled=False):
            with torch.no_grad():
                expected = plain(voxels, window_s)
            example = voxels.clone(), window_s.clone()
            graph = torch.cuda.make_graphed_callables(plain, example, pool=self.pool)
            with torch.no_grad():
                difference = (graph(voxels, window_s) - expected).abs().mean()
        if not difference < TOLERANCE:
            raise RuntimeError(f"frames of a graph differ by {float(difference):.3g}")
        return graph
