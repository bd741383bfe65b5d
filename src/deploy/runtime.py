"""Live: from the events of a window to a frame, numpy in and out, the state kept inside.

The dense grid is never made: an event adds its patch of the first layer's kernel to that layer's
map (`first_layer.py`), and what comes behind runs on OpenVINO or PyTorch.  Equal to the network's
`forward` on `voxel_grid`s up to the order of sums in float32 (`form="float32"`; 1e-5 in a frame or,
where a step of an E2VID's rounded state falls otherwise, 5e-4) or to bf16's rounding (0.04).
"""

import warnings
from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from src.deploy import openvino_network
from src.deploy.cpu_features import is_bf16_faster
from src.deploy.engines import events_numba as kernels
from src.deploy.first_layer import E2VIDOverEvents
from src.deploy.int8 import quantise_decoder_conv
from src.deploy.picture_size import check_picture_size
from src.deploy.setnet_tiles import SetNetTiles
from src.deploy.tile_batches import EagerBackend
from src.models.e2vid import E2VID
from src.models.folding import inference_copy
from src.models.network import LONGEST_WINDOW_S
from src.models.setnet import SetNet
from src.sim.optics import Position, check_positions
from src.sim.user_values import describe_coarse_times, is_number, read_array

EVENT_LIST_FORMS = ("float32", "bf16", "openvino")
SIDE_MULTIPLE = 8  # sides are padded to it by reflection, as the networks do
LEAST_INSIDE = 0.01  # of the events given for a window
MOST_THREADS = 1024  # a mistyped number of more would end the process without a word
WINDOW_RANGE_S = 1e-9, 1e12  # beyond, float32 ends
EDGE_STEPS = 4  # of float64, by which rounding puts an event of an edge outside
DTYPES = (np.float64, np.int64, np.int64, np.float32, np.int64)  # of t, x, y, p, view


def fastest_form() -> str:
    """Return the form that runs fastest with this processor and what is installed."""
    if openvino_network.is_installed():
        return "openvino"
    return "bf16" if is_bf16_faster() else "float32"


def supports_event_lists(network: object) -> bool:
    """Return whether `network` has a first layer that events can be added to one by one."""
    return isinstance(network, SetNet | E2VID)


class EventListRuntime:
    """A `SetNet` or `E2VID` over lists of events, window by window.

    `positions`: (row, col) of each view; `height`, `width`: of a view's picture and of the frame.
    `form`: openvino, float32 or bf16 (PyTorch); default: the `fastest_form`.
    `threads`: of what comes behind the first layer, which takes one or two; in 1..MOST_THREADS.
    Raises ValueError for another network, form, size or number of threads and for views of a number
    that the network does not take or, of an E2VID, that do not stand to each other as in `layout`.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        positions: Sequence[Position],
        height: int,
        width: int,
        threads: int = 2,
        form: str | None = None,
    ):
        form = form or fastest_form()
        if form not in EVENT_LIST_FORMS:
            raise ValueError(f"form must be one of {', '.join(EVENT_LIST_FORMS)}, got {form}")
        if not supports_event_lists(network):
            how = f"; use load({network!r})" if isinstance(network, str) else ""
            kind = type(network).__name__
            raise ValueError(f"a list of events needs a SetNet or an E2VID, got {kind}{how}")
        check_positions(positions)
        check_picture_size(height, width)
        check_thread_count(threads)
        self.views, self.size = len(positions), (height, width)
        missing = [-side % SIDE_MULTIPLE for side in self.size]  # as pad_centred_to_multiple
        self.padding = [(more // 2, more - more // 2) for more in missing]
        padded = height + sum(self.padding[0]), width + sum(self.padding[1])
        dtype = {"float32": torch.float32, "bf16": torch.bfloat16}.get(form)
        dtype = openvino_network.fastest_dtype() if dtype is None else dtype
        copied = inference_copy(network).cpu().float()
        backend = openvino_network.CompiledModule if form == "openvino" else EagerBackend
        self.runner: E2VIDOverEvents | SetNetTiles
        if isinstance(copied, SetNet):
            where = copied.checked_positions(self.views, copied.bins, positions)
            if form == "openvino":
                quantise_decoder_conv(copied)
            self.runner = SetNetTiles(copied, where, padded, dtype, backend, threads)
        else:
            assert isinstance(copied, E2VID)
            copied.check_positions(positions)
            self.runner = E2VIDOverEvents(copied, padded, dtype, backend, threads)
        self.state_arrays, self.warned = _describe_arrays(self.runner.state), set[str]()

    def step(self, t, x, y, p, view, t0: float, t1: float) -> Float[np.ndarray, "h w"]:
        """Return the frame at `t1`, float32, as the network's `forward` gives it.

        Events of one window in order of time, arrays of one length: `t`, `t0`, `t1` in seconds, the
        window of a length in WINDOW_RANGE_S, `x`, `y` in pixels, `view` an index into positions,
        `p` in {-1, 1}, of whole numbers never 0, or, as floats, weights; a warning says so, once,
        where these are 0 and 1 alone, as OFF and ON are in some files.
        Those outside t0 <= t <= t1, but for rounding, have no part in it; a warning says so where
        nearly all are.
        Raises ValueError, and leaves the state, for another window and for events that are out of
        order, off the sensor or in no view, masked arrays, and tensors that NumPy does not read.
        """
        return self.finish(self.begin(t, x, y, p, view, t0, t1))

    def begin(self, t, x, y, p, view, t0: float, t1: float) -> Any:
        """Do the first half of `step`, the events; another thread may `finish` it while this one
        begins the next window.
        """
        events = self._checked(t, x, y, p, view, t0, t1)
        t, x, y, p, view = self._reflected(*events)
        return self.runner.collect_events(t, x, y, p, view, float(t0), float(t1))

    def finish(self, begun: Any) -> Float[np.ndarray, "h w"]:
        """Return the frame of a window that was begun; in the order in which they were."""
        (top, _), (left, _) = self.padding
        height, width = self.size
        return self.runner(begun)[top : top + height, left : left + width].copy()

    def is_settled(self, state: Any) -> bool:
        """Return whether, from `state` on, the frame stays as it is until there are events."""
        return self.runner.is_settled(state)

    def advance_without_events(self, state: Any, seconds: float) -> Any:
        """Return `state`, one that `is_settled`, advanced in place by `seconds` without events."""
        return self.runner.advance_without_events(state, seconds)

    def reset(self) -> None:
        """Forget everything: the next window is the first."""
        self.runner.reset()

    @property
    def state(self) -> Any:
        """What lives from window to window, for `state = ...`; later windows advance it in place,
        so that going back to it takes a `copy.deepcopy`.  Set to None it is that of `reset`.  An
        E2VID's on OpenVINO holds OpenVINO's tensors, which cannot be pickled.

        Raises ValueError where it is set to one of other arrays: of another kind of network, size
        or, of a SetNet, number of views, of an E2VID, form.
        """
        return self.runner.state

    @state.setter
    def state(self, state: Any) -> None:
        if state is None:
            self.reset()
            return
        if _describe_arrays(state) != self.state_arrays:
            raise ValueError(
                "state must be that of a runtime of the same network, size, number of views and "
                f"form, got another {type(state).__name__}"
            )
        self.runner.state = state

    def _checked(self, t, x, y, p, view, t0, t1) -> list[np.ndarray]:
        columns = {"t": t, "x": x, "y": y, "p": p, "view": view}
        given = [read_array(name, values) for name, values in columns.items()]
        if len({part.shape for part in given}) != 1 or given[0].ndim != 1:
            shapes = [part.shape for part in given]
            raise ValueError(f"t, x, y, p, view must be of one length, got shapes {shapes}")
        _check_window(t0, t1)
        t, x, y, p, view = given
        if len(t) and not all(part.dtype.kind in "iu" for part in (x, y, view)):
            kinds = [str(part.dtype) for part in (x, y, view)]
            raise ValueError(f"x, y and view must be whole numbers, got {', '.join(kinds)}")
        if len(t) and (t.dtype.kind not in "iuf" or p.dtype.kind not in "iufb"):
            raise ValueError(f"t and p must be real numbers, got {t.dtype} and {p.dtype}")
        is_sign, typed = p.dtype.kind != "f", zip(given, DTYPES, strict=True)
        t, x, y, p, view = (np.ascontiguousarray(part, dtype) for part, dtype in typed)
        if kernels.has_event_error(t, x, y, p, view, self.views, *self.size, is_sign):
            raise ValueError(self._describe_error(t, x, y, p, view, is_sign))
        t = _clip_rounded(t, float(t0), float(t1))
        inside = np.searchsorted(t, t1, "right") - np.searchsorted(t, t0)
        self._warn_of_units(given[0], t0, t1)
        self._warn_of_polarities(given[3])
        if len(t) and inside < LEAST_INSIDE * len(t):
            reach = f"{t[0]:g} to {t[-1]:g}, the window is {t0:g} to {t1:g}"
            said = f"{inside} of {len(t)} events lie in the window: t is {reach}, in seconds"
            warnings.warn(said, stacklevel=4)
        return [t, x, y, p, view]

    def _warn_of_units(self, t: np.ndarray, t0: float, t1: float) -> None:
        if t1 - t0 > LONGEST_WINDOW_S:
            self._warn_once("length", f"a window lasts {t1 - t0:g} s: are t, t0 and t1 in seconds?")
        if said := describe_coarse_times(t, t1 - t0, " s"):
            self._warn_once("steps", said)

    def _warn_of_polarities(self, p: np.ndarray) -> None:
        """Warn of weights that are 0 and 1; others need one pass over them."""
        is_float = len(p) and p.dtype.kind == "f" and "p" not in self.warned
        if is_float and p.min() == 0 and p.max() == 1 and np.isin(p, (0, 1)).all():
            said = "p is 0 and 1 as floats, so that OFF events have no weight"
            self._warn_once("p", f"{said}: 2 * p - 1 gives OFF and ON")

    def _warn_once(self, what: str, said: str) -> None:
        """Warn; of windows alike once, as the text differs from one to the next."""
        if what not in self.warned:
            self.warned.add(what)
            warnings.warn(said, stacklevel=6)

    def _describe_error(self, t, x, y, p, view, is_sign: bool) -> str:
        """Return what is wrong with the first event that `has_event_error`."""
        height, width = self.size
        good = {
            "have finite t and p": np.isfinite(t) & np.isfinite(p),
            "be in order of time": np.append(True, ~(t[1:] < t[:-1])),
            f"have x in 0..{width - 1} and y in 0..{height - 1}": (
                (x >= 0) & (x < width) & (y >= 0) & (y < height)
            ),
            f"have view in 0..{self.views - 1}, an index into positions": (
                (view >= 0) & (view < self.views)
            ),
            "have p in -1, 1 (or weights, as floats)": (abs(p) == 1) | (not is_sign),
        }
        first = {rule: int(is_good.argmin()) for rule, is_good in good.items() if not is_good.all()}
        rule, at = min(first.items(), key=lambda found: found[1])
        got = f"t={t[at]} x={x[at]} y={y[at]} p={p[at]} view={view[at]}"
        return f"events must {rule}, got event {at} with {got}"

    def _reflected(self, t, x, y, p, view) -> list[np.ndarray]:
        """Return the events in padded pixels, those near a padded edge once more behind it."""
        events = [t, x, y, p, view]
        for axis, side, (before, behind) in zip((2, 1), self.size, self.padding, strict=True):
            if before + behind:
                place = events[axis]
                low = (place >= 1) & (place <= before)
                high = (place <= side - 2) & (place >= side - 1 - behind)
                mirrored = [place, -place[low], 2 * (side - 1) - place[high]]
                events = [np.concatenate([part, part[low], part[high]]) for part in events]
                events[axis] = np.concatenate(mirrored) + before
        return events


def check_thread_count(threads: Any) -> None:
    """Raise ValueError unless `threads` is a whole number in 1..MOST_THREADS."""
    if not isinstance(threads, Integral) or not 1 <= int(threads) <= MOST_THREADS:
        raise ValueError(f"threads must be in 1..{MOST_THREADS}, got {threads}")


def _check_window(t0: Any, t1: Any) -> None:
    least, most = WINDOW_RANGE_S
    are_numbers = is_number(t0) and is_number(t1)
    if not are_numbers or not least <= float(t1) - float(t0) <= most:
        wanted = f"t0 < t1 in seconds, {least:g} to {most:g} s apart"
        raise ValueError(f"a window must have {wanted}, got {t0} and {t1}")


def _clip_rounded(t: np.ndarray, t0: float, t1: float) -> np.ndarray:
    """Return ordered `t`; what lies outside t0..t1 by rounding alone lies on the edge."""
    if not len(t) or (t[0] >= t0 and t[-1] <= t1):
        return t
    slack = EDGE_STEPS * np.spacing(max(abs(t0), abs(t1)))
    is_near = (t >= t0 - slack) & (t <= t1 + slack)
    return np.where(is_near, t.clip(t0, t1), t)


def _describe_arrays(state: Any) -> Any:
    """Return a state with types and sizes in place of its arrays, tensors and numbers."""
    if hasattr(state, "shape"):
        return type(state).__name__, str(getattr(state, "dtype", "")), tuple(state.shape)
    if isinstance(state, tuple | list):
        return type(state).__name__, [_describe_arrays(part) for part in state]
    if hasattr(state, "__dict__"):
        parts = {name: _describe_arrays(part) for name, part in vars(state).items()}
        return type(state).__name__, parts
    return () if isinstance(state, int | float) else type(state).__name__
