"""A training sequence as CUDA graphs: one launch forward, one backward, instead of thousands."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import parametrize

from src.models.unroll import unroll

TOLERANCE = 0.02  # of frames in [0, 1]: a graph that differs by more, in bf16 too, is not used


class Unrolled(nn.Module):
    """What a network makes of the windows `shown` of a sequence that starts from no state."""

    def __init__(self, network: nn.Module, positions: Sequence | None, shown: Sequence[int]):
        super().__init__()
        self.network, self.positions, self.shown = network, positions, shown

    def forward(self, voxels: Tensor, window_s: Tensor) -> Float[Tensor, "n shown 1 h w"]:
        """Return the frames; voxels (n, windows, views, bins, h, w), window_s (n,)."""
        options = {"window_s": window_s, "positions": self.positions, "shown": self.shown}
        with parametrize.cached():
            return unroll(self.network, voxels, **options)[0]


class GraphedUnroll:
    """Unrolls `network` over batches on a GPU: the first batch of each size and each set of windows
    shown one operator after the other, those that follow as a CUDA graph.

    A graph replays one fixed series of launches, so the sizes and the sets of windows should be
    few; at most `most` graphs are made, all of one pool of memory.  The first time that a graph
    cannot be made, runs out of memory or gives other frames, graphs are given up for good, which
    `say` is told.
    """

    def __init__(self, network: nn.Module, most: int = 24, say: Callable[[str], None] = print):
        self.network, self.most, self.say = network, most, say
        self.seen: set[tuple] = set()
        self.graphs: dict[tuple, Callable] = {}
        self.pool, self.given_up = None, False

    def __call__(
        self,
        voxels: Float[Tensor, "n windows views bins h w"],
        window_s: Float[Tensor, " n"],
        positions: Sequence[tuple[int, int]] | None,
        shown: Sequence[int],
    ) -> Float[Tensor, "n shown 1 h w"]:
        """Return the frames of the windows `shown`, with their graph of gradients."""
        places = None if positions is None else tuple(map(tuple, positions))
        name = (tuple(voxels.shape), voxels.dtype, places, tuple(shown))
        if name in self.graphs:
            return self.graphs[name](voxels, window_s)
        plain = Unrolled(self.network, positions, shown)
        if self.given_up or name not in self.seen or len(self.graphs) >= self.most:
            self.seen.add(name)
            return plain(voxels, window_s)
        try:
            graph = self._captured(plain, voxels, window_s)
        except Exception as error:  # whatever a driver, a kernel or the memory says
            self.given_up, self.graphs = True, {}
            torch.cuda.empty_cache()
            self.say(f"step: no CUDA graphs, operators one by one: {' '.join(str(error).split())}")
            return plain(voxels, window_s)
        self.graphs[name] = graph
        return graph(voxels, window_s)

    def _captured(self, plain: Unrolled, voxels: Tensor, window_s: Tensor) -> Callable:
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
                difference = (graph(voxels, window_s) - expected).abs().max()
        if not difference < TOLERANCE:
            raise RuntimeError(f"frames of a graph differ by {float(difference):.3g}")
        return graph
