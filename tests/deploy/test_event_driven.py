"""A SetNet computed where events fall gives the frames of the dense network."""

import copy

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from src.deploy import openvino_network, setnet_tiles
from src.deploy.runtime import EventListRuntime
from src.models.setnet import SetNet
from src.sim.voxel import voxel_grid
from tests.deploy.conftest import form

pytestmark = pytest.mark.usefixtures("unchecked")
EXACT = 1e-5
WINDOWS = 20
FORMS = ["float32", "openvino"]
QUIET, ALONE, BLOB, EVERYWHERE = "quiet", "alone", "blob", "everywhere"


def network(refine_fusion: bool, gate_rank: int | None) -> SetNet:
    """A small network, all of whose weights matter: none is zero, and the frame has contrast."""
    torch.manual_seed(0)
    made = SetNet(
        channels=4, context_channels=[6, 8, 10], refine_fusion=refine_fusion, gate_rank=gate_rank
    ).eval()
    for module in made.modules():
        if isinstance(module, torch.nn.Conv2d):
            fan = module.weight[0].numel()
            torch.nn.init.normal_(module.weight, 0, 1.5 / fan**0.5)
            if module.bias is not None:
                torch.nn.init.normal_(module.bias, 0, 0.2)
    return made.requires_grad_(False)


NETWORKS = {"small": network(False, None), "medium": network(True, 3)}


def scene(kinds: list[str], seed: int, views: int, height: int, width: int, fps: float) -> list:
    """Windows (t, x, y, p, view, t0, t1), each of a kind; blobs jump between two far places."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 1, (2, 2)) * (height, width)
    made = []
    for k, kind in enumerate(kinds):
        t0, t1 = k / fps, (k + 1) / fps
        count = {QUIET: 0, ALONE: 2, BLOB: 150, EVERYWHERE: height * width // 8}[kind]
        t, middle = np.sort(rng.uniform(t0, t1, count)), places[rng.integers(0, 2)]
        if kind == BLOB:
            y, x = (middle + rng.normal(0, 5, (count, 2))).T
        else:
            y, x = rng.uniform(0, height, count), rng.uniform(0, width, count)
        x, y = x.clip(0, width - 1).astype(np.uint16), y.clip(0, height - 1).astype(np.uint16)
        p = (2 * rng.integers(0, 2, count) - 1).astype(np.int8)
        made.append((t, x, y, p, rng.integers(0, views, count), t0, t1))
    return made


def positions(views: int) -> list[tuple[int, int]]:
    """Places in a square of three by three, from the centre on."""
    return [((k + 4) % 9 // 3 - 1, (k + 4) % 3 - 1) for k in range(views)]


def grids(window: tuple, views: int, height: int, width: int) -> torch.Tensor:
    t, x, y, p, view, t0, t1 = window
    size = {"t0": t0, "t1": t1, "bins": 5, "height": height, "width": width}
    mine = [view == k for k in range(views)]
    return torch.stack([voxel_grid(t[m], x[m], y[m], p[m], **size) for m in mine])[None]


def largest_gap(net: SetNet, live: EventListRuntime, windows: list, views: int) -> float:
    """Return the largest difference of frames, hidden maps and contexts, over their largest value
    where that is above 1.  The clock must be equal to the last bit."""
    state, gap, places = None, 0.0, positions(views)
    for window in windows:
        seconds = window[6] - window[5]
        grid = grids(window, views, *live.size)
        frame, state = net(grid, state, window_s=seconds, positions=places)
        got = live.step(*window)
        maps = live.runner.state.maps
        pairs = [
            (frame[0, 0], got),
            (state.hidden[0].permute(1, 2, 0), maps.hidden),
            (state.context_average[0].permute(1, 2, 0), maps.context),
            (state.context_smoothed[0].permute(1, 2, 0), maps.smoothed),
        ]
        clock = live.runner.state.clock
        np.testing.assert_array_equal(state.event_trace[0], clock.trace[:, 1:-1, 1:-1])
        np.testing.assert_array_equal(state.activity[0, 0], clock.activity)
        np.testing.assert_array_equal(state.is_pending[0, 0], clock.is_pending)
        np.testing.assert_allclose(state.evidence[0, 0], clock.evidence, rtol=1e-5, atol=EXACT)
        for a, b in ((a.numpy(), b) for a, b in pairs):
            gap = max(gap, float(abs(a - b).max() / max(1, abs(a).max())))
    return gap


@pytest.fixture
def in_float32(monkeypatch):
    """OpenVINO in float32, whatever the processor is fast in."""
    monkeypatch.setattr(openvino_network, "fastest_dtype", lambda: torch.float32)


@pytest.fixture
def two_batch_sizes(monkeypatch):
    """Each size is compiled, for each network and frame: two of five."""
    monkeypatch.setattr(setnet_tiles, "BATCHES", (8, 32))


@pytest.mark.usefixtures("in_float32", "two_batch_sizes")
@pytest.mark.parametrize("backend", FORMS)
@settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    name=st.sampled_from(sorted(NETWORKS)),
    kinds=st.lists(
        st.sampled_from([QUIET, ALONE, BLOB, BLOB, EVERYWHERE]),
        min_size=WINDOWS,
        max_size=WINDOWS,
    ),
    size=st.tuples(st.integers(9, 150), st.integers(9, 150)),
    views=st.integers(1, 9),
    fps=st.sampled_from([120.0, 317.0, 600.0, 3000.0, 12000.0]),
    seed=st.integers(0, 999),
)
def test_any_activity_gives_the_dense_frames(backend, name, kinds, size, views, fps, seed):
    height, width = size
    net, windows = NETWORKS[name], scene(kinds, seed, views, height, width, fps)
    live = EventListRuntime(
        net, positions=positions(views), height=height, width=width, threads=1, form=form(backend)
    )
    assert largest_gap(net, live, windows, views) < EXACT


@pytest.mark.parametrize("backend", FORMS)
def test_from_tiles_to_the_whole_frame_and_back(backend, in_float32):
    net = NETWORKS["medium"]
    kinds = [EVERYWHERE, BLOB, QUIET, EVERYWHERE, BLOB] * 4
    windows = scene(kinds, 3, 4, 96, 128, 120.0)
    live = EventListRuntime(
        net, positions=positions(4), height=96, width=128, threads=2, form=form(backend)
    )
    ways = {"whole": 0, "tiles": 0}
    whole, tiles = live.runner.whole.advance_and_draw, live.runner._remember

    def count(name, work):
        def counted(*given):
            ways[name] += 1
            work(*given)

        return counted

    live.runner.whole.advance_and_draw = count("whole", whole)
    live.runner._remember = count("tiles", tiles)
    assert largest_gap(net, live, windows, 4) < EXACT
    assert min(ways.values()) >= 4


@pytest.mark.parametrize("share", [0.0, 9.0])
def test_either_way_all_the_time(share, monkeypatch):
    """Whole maps although little changes, tiles although all does."""
    for name in ("WHOLE_MEMORY", "WHOLE_CONTEXT", "WHOLE_DECODER"):
        monkeypatch.setattr(setnet_tiles, name, share)
    windows = scene([EVERYWHERE, BLOB, BLOB, QUIET] * 5, 5, 2, 72, 100, 120.0)
    live = EventListRuntime(
        NETWORKS["medium"], positions=positions(2), height=72, width=100, form="float32"
    )
    assert largest_gap(NETWORKS["medium"], live, windows, 2) < EXACT


def test_what_no_event_reaches_keeps_its_bits():
    kinds = [BLOB] * 12
    windows = scene(kinds, 1, 1, 40, 400, 600.0)
    windows = [(t, x.clip(0, 60), *rest) for t, x, *rest in windows]
    live = EventListRuntime(
        NETWORKS["medium"], positions=positions(1), height=40, width=400, form="float32"
    )
    for window in windows:
        frame = live.step(*window)
        assert np.ptp(frame[:, 100:]) == 0  # the background
    assert np.ptp(frame) > 0.05
    assert not live.runner.state.maps.hidden[:, 60:].any()


def test_two_states_take_turns():
    """As overlapping windows do: each state goes on where it was, whatever ran in between."""
    net = NETWORKS["small"]
    one, other = (scene([BLOB, QUIET, EVERYWHERE, BLOB], seed, 1, 64, 64, 600.0) for seed in (1, 2))

    def make() -> EventListRuntime:
        return EventListRuntime(net, positions=positions(1), height=64, width=64, form="float32")

    alone = []
    for windows in (one, other):
        live = make()
        alone.append([live.step(*window) for window in windows])
    live, states = make(), [None, None]
    for k in range(4):
        for turn, windows in enumerate((one, other)):
            live.state = states[turn]
            frame, states[turn] = live.step(*windows[k]), live.state
            np.testing.assert_array_equal(frame, alone[turn][k])


def test_a_copy_of_the_state_goes_back():
    windows = scene([BLOB, EVERYWHERE, BLOB, BLOB], 7, 1, 64, 64, 120.0)
    live = EventListRuntime(
        NETWORKS["medium"], positions=positions(1), height=64, width=64, form="float32"
    )
    live.step(*windows[0])
    kept = copy.deepcopy(live.state)
    frames = [live.step(*window) for window in windows[1:]]
    live.state = kept
    for window, frame in zip(windows[1:], frames, strict=True):
        np.testing.assert_array_equal(live.step(*window), frame)
