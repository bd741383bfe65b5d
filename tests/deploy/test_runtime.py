"""From a list of events to a frame: what the dense grid gives, without the grid."""

import copy
import gc
import inspect
import os
import sys
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines.firenet import FireNet
from src.deploy import int8, openvino_network, setnet_tiles
from src.deploy.cpu_features import has_int8_dot_product
from src.deploy.int8 import MAX_ACTIVATION, MIN_CHANNELS, Int8Conv, quantise_decoder_conv
from src.deploy.openvino_network import CompiledModule, OpenVinoNetwork
from src.deploy.runtime import EventListRuntime
from src.models.e2vid import E2VID
from src.models.setnet import SetNet
from src.sim.optics import layout
from src.sim.voxel import voxel_grid
from tests.conftest import default_dtype
from tests.deploy.conftest import form

EXACT, ROUNDED = 1e-5, 0.02  # in grey levels: sums in another order, and bf16
NETWORKS = {
    "setnet": lambda: SetNet(channels=4),
    "setnet_in_bytes": lambda: SetNet(channels=MIN_CHANNELS, context_channels=[8, 8, 8]),
    "setnet_of_rank_3": lambda: SetNet(channels=4, gate_rank=3),
    "e2vid": lambda: E2VID(views=9, base_channels=4, spectral_norm=True),
    "e2vid_gru_3x3": lambda: E2VID(
        views=9, base_channels=4, recurrent="convgru", kernel_size=3, final_activation="none"
    ),
    "e2vid_stem": lambda: E2VID(views=9, base_channels=4, stem_channels=6),
}
FORMS = ["bf16", "openvino"]
OPENVINO = pytest.mark.skipif(
    not openvino_network.is_installed(), reason="needs the extra openvino"
)


@pytest.fixture(autouse=True)
def batches_of_a_small_picture(monkeypatch):
    """Of tiles: the smallest alone, which holds all, as each size is compiled."""
    monkeypatch.setattr(setnet_tiles, "BATCHES", setnet_tiles.BATCHES[:1])


def network(name: str) -> torch.nn.Module:
    torch.manual_seed(0)
    return NETWORKS[name]().eval()


def events(seed: int, count: int = 400, height: int = 24, width: int = 32, views: int = 9) -> dict:
    """Events of a window of 1/600 s, also on its edges and on those of the picture."""
    rng = np.random.default_rng(seed)
    t0, t1 = seed / 600, (seed + 1) / 600
    t = np.sort(rng.uniform(t0, t1, count))
    if count:
        t[0], t[-1] = t0, t1
    return {
        "t": t, "x": rng.integers(0, width, count).astype(np.uint16),
        "y": rng.integers(0, height, count).astype(np.uint16),
        "p": (2 * rng.integers(0, 2, count) - 1).astype(np.int8),
        "view": rng.integers(0, views, count), "t0": t0, "t1": t1,
    }  # fmt: skip


def grids(window: dict, height: int = 24, width: int = 32, views: int = 9) -> torch.Tensor:
    size = {"bins": 5, "height": height, "width": width}
    edges = {"t0": window["t0"], "t1": window["t1"]}
    parts = []
    for view in range(views):
        mine = window["view"] == view
        parts.append(voxel_grid(*(window[name][mine] for name in "txyp"), **edges, **size))
    return torch.stack(parts)[None]


def dense(net: torch.nn.Module, windows: list[dict], **size) -> list[np.ndarray]:
    state, shown = None, []
    with torch.no_grad():
        for window in windows:
            seconds = window["t1"] - window["t0"]
            told = {"window_s": seconds} if isinstance(net, SetNet) else {}
            frame, state = net(grids(window, **size), state, **told)
            shown.append(frame[0, 0].numpy())
    return shown


def runtime(
    net: torch.nn.Module, form: str = "float32", views: int = 9, **size
) -> EventListRuntime:
    size = {"height": 24, "width": 32} | size
    return EventListRuntime(net, positions=layout(views), threads=1, form=form, **size)


@cache
def compiled_runtime(name: str, form: str) -> EventListRuntime:
    """Return one of nine views that only its state tells from a new one."""
    return runtime(network(name), form)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(("height", "width"), [(24, 32), (19, 29)])
def test_events_one_by_one_are_the_dense_grid(name, height, width):
    net, size = network(name), {"height": height, "width": width}
    windows = [events(seed, 0 if seed == 2 else 400, **size) for seed in range(12)]
    found, live = dense(net, windows, **size), runtime(net, **size)
    for window, frame in zip(windows, found, strict=True):
        np.testing.assert_allclose(live.step(**window), frame, atol=EXACT)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("rounded", FORMS)
def test_rounded_forms_stay_near_the_dense_grid(name, rounded):
    net, windows = network(name), [events(seed) for seed in range(12)]
    live = compiled_runtime(name, form(rounded))
    live.reset()
    for window, frame in zip(windows, dense(net, windows), strict=True):
        got = live.step(**window)
        assert got.dtype == np.float32 and got.shape == (24, 32)
        np.testing.assert_allclose(got, frame, atol=ROUNDED)


@pytest.mark.parametrize("views", [1, 4, 25])
def test_any_number_of_views(views):
    net, window = network("setnet"), events(0, views=views)
    with torch.no_grad():
        frame, _ = net(grids(window, views=views), None, window_s=1 / 600)
    got = runtime(net, views=views).step(**window)
    np.testing.assert_allclose(got, frame[0, 0], atol=EXACT)


def test_an_event_alone_changes_nothing():
    net = network("setnet")
    one = events(0, 1) | {"t": np.array([0.0005]), "x": np.array([4]), "y": np.array([6])}
    live = runtime(net)
    frame = live.step(**one)
    np.testing.assert_allclose(frame, dense(net, [one])[0], atol=EXACT)
    assert np.ptp(frame) == 0 and not live.runner.state.clock.elapsed_s.any()


def test_a_pixel_may_weigh_a_part():
    """As events laid bilinearly into the picture do."""
    net, window = network("setnet"), events(0)
    halves = {name: np.repeat(window[name], 2) for name in ("t", "x", "y", "view")}
    halves |= {"p": np.repeat(window["p"], 2) * np.tile([0.25, 0.75], 400)}
    one, two = runtime(net).step(**window), runtime(net).step(**window | halves)
    np.testing.assert_allclose(one, two, atol=EXACT)


def test_microseconds_for_seconds_are_told_of():
    window = events(0)
    with pytest.warns(UserWarning, match="1 of 400 events lie in the window.*in seconds"):
        runtime(network("e2vid")).step(**window | {"t": 1e6 * window["t"]})


def test_times_in_microseconds_throughout_are_told_of():
    window = events(0)
    scaled = {name: 1e9 * (1 + window[name]) for name in ("t", "t0", "t1")}
    with pytest.warns(UserWarning, match="a window lasts 1.66667e.06 s: are t, t0 and t1 in sec"):
        runtime(network("e2vid")).step(**window | scaled)


def test_times_too_coarse_for_the_window_are_told_of():
    late = {name: 3600 + events(0)[name] for name in ("t", "t0", "t1")}
    late["t"] = late["t"].clip(late["t0"], late["t1"]).astype(np.float32)
    with pytest.warns(UserWarning, match="t is float32, in steps of 0.000244141 s at 3600 s"):
        runtime(network("e2vid")).step(**events(0) | late)


@pytest.mark.parametrize(
    ("t", "words"),
    [
        (torch.zeros(400, requires_grad=True), "^t must be an array .* requires grad"),
        (np.ma.masked_array(np.zeros(400), True), "^t must be without a mask, got a masked array"),
    ],
)
def test_arrays_that_cannot_be_read_are_named(t, words):
    with pytest.raises(ValueError, match=words):
        runtime(network("e2vid")).step(**events(0) | {"t": t})


def test_off_events_of_weight_0_are_told_of_once():
    window, live = events(0), runtime(network("e2vid"))
    on = (window["p"] > 0).astype(np.float64)
    with pytest.warns(UserWarning, match="p is 0 and 1 as floats, so that OFF .*: 2 . p - 1 gives"):
        live.step(**window | {"p": on})
    for weights in (on, np.ones_like(on), 0.5 * on, 2 * on - 1):
        with warnings.catch_warnings(action="error"):
            live.step(**window | {"p": weights})
            live.reset()
    with warnings.catch_warnings(action="error"):
        for weights in (np.ones_like(on), np.zeros_like(on), 0.5 * on, 2 * on - 1):
            runtime(network("e2vid")).step(**window | {"p": weights})


@pytest.mark.parametrize("name", ["setnet", "e2vid"])
def test_a_state_of_another_runtime_is_refused(name):
    live = runtime(network(name))
    other = {"setnet": "e2vid", "e2vid": "setnet"}[name]
    states = [runtime(network(other)).state, runtime(network(name), width=40).state, 5]
    if name == "setnet":
        states.append(runtime(network(name), views=3).state)
    else:
        states.append(runtime(network(name), "bf16").state)
    for state in states:
        with pytest.raises(ValueError, match="state must be that of a runtime of the same network"):
            live.state = state
    live.step(**events(0))


def test_events_outside_the_window_have_no_part():
    net, window = network("setnet"), events(1)
    early = {name: window[name] for name in ("x", "y", "p", "view")}
    more = {name: np.concatenate([part, part]) for name, part in early.items()}
    more["t"] = np.concatenate([window["t"] - 1 / 300, window["t"]])
    np.testing.assert_array_equal(runtime(net).step(**window), runtime(net).step(**window | more))


@pytest.mark.parametrize("name", ["setnet", "e2vid"])
def test_an_event_of_an_edge_is_not_rounded_out_of_its_window(name):
    """As 25000 * 1e-6 is below 3 / 120; an event a nanosecond outside has no part in it."""
    net, window = network(name), events(30)
    rounded, outside = window["t"].copy(), window["t"].copy()
    rounded[0], rounded[-1] = np.nextafter(rounded[0], 0), np.nextafter(rounded[-1], 1)
    given = rounded.copy()
    found = runtime(net).step(**window | {"t": given})
    np.testing.assert_array_equal(found, runtime(net).step(**window))
    np.testing.assert_array_equal(given, rounded)
    outside[0] -= 1e-9
    later = {part: window[part][1:] for part in ("t", "x", "y", "p", "view")}
    expected = runtime(net).step(**window | later)
    np.testing.assert_array_equal(runtime(net).step(**window | {"t": outside}), expected)


@pytest.mark.parametrize("rounded", ["float32", *FORMS])
@pytest.mark.parametrize("name", ["setnet", "e2vid"])
def test_reset_forgets_and_a_state_goes_on(name, rounded):
    live = compiled_runtime(name, form(rounded))
    live.reset()
    first = live.step(**events(0))
    kept = copy.deepcopy(live.state)
    second = live.step(**events(1))
    live.reset()
    np.testing.assert_array_equal(live.step(**events(0)), first)
    live.step(**events(2))
    live.state = kept
    np.testing.assert_array_equal(live.step(**events(1)), second)
    live.state = None
    np.testing.assert_array_equal(live.step(**events(0)), first)


def test_what_leaks_is_mixed_as_it_was_before_it_leaked():
    live = runtime(network("setnet"))
    for seed in range(300):
        live.step(**events(seed, count=40))
    sums, found = live.runner.state.sums.sums.transpose(1, 2, 0, 3), live.runner.state.sums.mixtures
    mixed = np.einsum("vp,vmrc->rcpm", live.runner.events.code[:, ::2], sums)
    spread = np.abs(sums - sums.mean(0)).mean(0).transpose(1, 2, 0)
    expected = np.concatenate([mixed.reshape(*found.shape[:2], -1), spread], 2)
    np.testing.assert_allclose(found, expected, atol=EXACT)
    assert np.abs(expected).max() > 0.1


WRONG = {
    "events must be in order of time": {"t": lambda t: t[::-1]},
    r"x in 0\.\.31 and y in 0\.\.23, got event 0 .* x=32": {"x": lambda x: x + 32},
    r"have view in 0\.\.8": {"view": lambda view: view + 9},
    "events must have p in -1, 1": {"p": lambda p: (p + 1) // 2},
    "finite t and p": {"p": lambda p: p * np.nan},
    "t, x, y, p, view must be of one length": {"x": lambda x: x[1:]},
    "x, y and view must be whole numbers": {"x": lambda x: x + 0.5},
    "t and p must be real numbers": {"t": lambda t: (t * 1e6).astype("datetime64[us]")},
    "a window must have t0 < t1": {"t1": lambda t1: -1.0},
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_events_are_named_and_change_nothing(words):
    live, window = runtime(network("setnet")), events(0, height=1, width=1)
    live.step(**window)
    before = copy.deepcopy(live.state)
    with pytest.raises(ValueError, match=words):
        live.step(**window | {name: spoil(window[name]) for name, spoil in WRONG[words].items()})
    np.testing.assert_array_equal(live.step(**events(1)), go_on(live, before, **events(1)))


def go_on(live: EventListRuntime, state, **window) -> np.ndarray:
    live.state = state
    return live.step(**window)


CROWD = {"positions": [(0, k) for k in range(26)]}
ROW = {"positions": [(0, k) for k in range(9)]}


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("setnet", CROWD, r"views must be in 1\.\.25 .*, got 26"),
        (
            "e2vid",
            {"positions": layout(4)},
            "^positions must be 9 .row, col., one for each view, got 4",
        ),
        ("e2vid", ROW, "^positions must be arranged as .* for this network, got .*, 8"),
        ("e2vid", {"positions": [(0, 0)] * 9}, "^positions must be arranged as"),
        ("e2vid", {"positions": layout(9)[::-1]}, "^positions must be arranged as"),
        (
            "setnet",
            {"height": 7},
            "must be >= 8 px.*resolution, else sensor_size.*, got 7 and",
        ),
        ("setnet", {"threads": 0}, r"threads must be in 1\.\.1024, got 0"),
        ("setnet", {"threads": 10**6}, r"threads must be in 1\.\.1024, got 1000000"),
        ("setnet", {"form": "float16"}, "form must be one of float32, bf16, openvino"),
    ],
)
def test_what_does_not_fit_is_named(name, options, words):
    size = {"positions": layout(9), "height": 24, "width": 32}
    with pytest.raises(ValueError, match=words):
        EventListRuntime(network(name), **size | options)


def test_a_square_of_any_spacing_is_what_an_e2vid_takes():
    how = {"height": 24, "width": 32, "form": "float32", "threads": 1}
    far = [(2 * row, 5 * column + 1) for row, column in layout(9)]
    live = EventListRuntime(network("e2vid"), positions=far, **how)
    expected = runtime(network("e2vid")).step(**events(0))
    np.testing.assert_array_equal(live.step(**events(0)), expected)


def test_another_network_is_refused():
    with pytest.raises(ValueError, match="a list of events needs a SetNet or an E2VID, got FireN"):
        EventListRuntime(FireNet(), positions=layout(1), height=24, width=32)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"positions": [0, 0]}, r"positions must be the \(row, col\) of each view, got \[0, 0\]"),
        ({"positions": ["ab"] * 9}, r"positions must be the \(row, col\) of each view, got \['ab'"),
        ({"positions": 9}, r"positions must be the \(row, col\) of each view, got 9"),
        ({"height": 64.5}, "height and width must be >= 8 px, whole .*, got 64.5 and 32"),
        ({"threads": "2"}, r"threads must be in 1\.\.1024, got 2"),
        ({"threads": None}, r"threads must be in 1\.\.1024, got None"),
        ({"threads": 1.5}, r"threads must be in 1\.\.1024, got 1\.5"),
        ({"network": "setnet_small"}, r"got str; use load\('setnet_small'\)"),
    ],
)
def test_what_is_of_another_type_is_named(options, words):
    make = inspect.unwrap(EventListRuntime.__init__)  # without the type checks of tests
    given = {"network": network("setnet"), "positions": layout(9), "height": 24, "width": 32}
    with pytest.raises(ValueError, match=words):
        make(EventListRuntime.__new__(EventListRuntime), **given | options)


@pytest.mark.parametrize("name", ["setnet", "e2vid"])
@pytest.mark.parametrize(
    ("t0", "t1"), [("0", 1.0), (None, 1.0), (0.0, None), (0.0, 1e-46), (0.0, 1e300), (0.0, np.inf)]
)
def test_a_window_of_another_length_is_named_and_changes_nothing(name, t0, t1):
    live = runtime(network(name))
    check = inspect.unwrap(EventListRuntime._checked)  # without the type checks of tests
    live.step(**events(0))
    before = copy.deepcopy(live.state)
    times = {"t0": t0, "t1": t1}
    wanted = r"a window must have t0 < t1 in seconds, 1e-09 to 1e\+12 s apart, got "
    with pytest.raises(ValueError, match=wanted):
        check(live, **events(0, 0) | times)
    np.testing.assert_array_equal(live.step(**events(1)), go_on(live, before, **events(1)))


@pytest.mark.parametrize("length_s", [1e-9, 1e12])
def test_frames_of_the_shortest_and_the_longest_window_are_finite(length_s):
    live, window = runtime(network("setnet")), events(0)
    long = {"t": window["t"] * 600 * length_s, "t0": 0.0, "t1": length_s}
    with warnings.catch_warnings(action="ignore"):
        assert np.isfinite(live.step(**window | long)).all()
    assert np.isfinite(live.step(**events(1))).all()


@pytest.mark.parametrize("kind", ["float32", pytest.param("openvino", marks=OPENVINO)])
@pytest.mark.parametrize("name", ["setnet", "e2vid"])
def test_the_default_type_of_tensors_changes_nothing(name, kind, unchecked):
    net = network(name)
    found = [runtime(net, kind).step(**events(0))]
    with default_dtype(torch.float64):
        found.append(runtime(net, kind).step(**events(0)))
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
@pytest.mark.parametrize("name", ["setnet", "e2vid"])
def test_a_network_of_another_type_runs_in_float32(name, dtype):
    net = network(name).to(dtype)
    found = runtime(net).step(**events(0))
    np.testing.assert_allclose(found, runtime(net.float()).step(**events(0)), atol=EXACT)


def test_without_the_package_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(openvino_network, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="form=openvino needs pip install openvino"):
        runtime(network("setnet"), "openvino")
    assert runtime(network("setnet"), None).step(**events(0)).shape == (24, 32)


@OPENVINO
@pytest.mark.parametrize("name", ["setnet", "e2vid"])
def test_openvino_gives_the_frames_of_the_network(name, unchecked):
    net, windows = network(name), [events(seed) for seed in range(4)]
    found, state, told = OpenVinoNetwork(net), None, {}
    for window, frame in zip(windows, dense(net, windows), strict=True):
        if name == "setnet":
            told = {"window_s": window["t1"] - window["t0"], "positions": layout(9)}
        given = state
        got, state = found(grids(window), state, **told)
        np.testing.assert_allclose(got[0, 0], frame, atol=ROUNDED)
    again, _ = found(grids(windows[-1]), given, **told)
    assert torch.equal(again, got)  # a state that was given back stays as it is


@OPENVINO
def test_openvino_reports_its_use_to_nobody(unchecked):
    CompiledModule(torch.nn.ReLU(), [torch.zeros(1)], 1)
    assert not any(name.startswith("openvino_telemetry.") for name in sys.modules)


@OPENVINO
def test_openvino_refuses_a_state_of_another_size_and_a_batch(unchecked):
    found = OpenVinoNetwork(network("setnet"))
    _, state = found(torch.zeros(1, 9, 5, 16, 16))
    with pytest.raises(ValueError, match=r"state must be of voxels \(1, 9, 5, 24, 24\)"):
        found(torch.zeros(1, 9, 5, 24, 24), state)
    with pytest.raises(ValueError, match="form=openvino takes one clip on device=cpu, got 2"):
        found(torch.zeros(2, 9, 5, 16, 16))


def resident_mb() -> float:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@OPENVINO
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux")
def test_what_was_compiled_leaves_no_memory_behind():
    """A graph of torch.jit.trace stays for good, with these weights of 16 MB."""
    example = [torch.zeros(1, 2048)]
    CompiledModule(torch.nn.Linear(2048, 2048), example, 1)
    before = resident_mb()
    for _ in range(6):
        CompiledModule(torch.nn.Linear(2048, 2048), example, 1)
    assert resident_mb() - before < 40


@OPENVINO
def test_a_part_that_openvino_cannot_express_is_named():
    with pytest.raises(ValueError, match="Identity has a part that OpenVINO cannot express"):
        CompiledModule(torch.nn.Identity(3), [torch.zeros(1), torch.zeros(1)], 1)


@OPENVINO
def test_ctrl_c_while_openvino_compiles_is_no_error_of_the_network():
    class Interrupted(torch.nn.Module):
        def forward(self, *given):
            raise RuntimeError("KeyboardInterrupt: ")  # OpenVINO's own error of it

    with pytest.raises(KeyboardInterrupt):
        CompiledModule(Interrupted(), [torch.zeros(1), torch.zeros(1)], 1)


def test_bytes_round_to_half_a_step():
    torch.manual_seed(0)
    conv, x = torch.nn.Conv2d(6, 5, 3), MAX_ACTIVATION * torch.rand(1, 6, 9, 9)
    step = conv.weight.abs().amax((1, 2, 3), keepdim=True) / 127
    most = x.amax() * (step / 2).sum((1, 2, 3)) * 6 * 9  # what the weights can be off
    most += MAX_ACTIVATION / 255 / 2 * (conv.weight.abs() + step / 2).sum((1, 2, 3))
    with torch.no_grad():
        off = (Int8Conv(conv)(x) - conv(x)).abs().amax((0, 2, 3))
        cut = Int8Conv(conv)(10 * x) - Int8Conv(conv)((10 * x).clamp_max(MAX_ACTIVATION))
    assert (off > 0).all() and (off < most).all() and not cut.any()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
@pytest.mark.parametrize(
    ("name", "able", "drawn"),
    [
        ("setnet_in_bytes", True, True),
        ("setnet_in_bytes", False, False),
        ("setnet", True, False),
        ("e2vid", True, False),
    ],
)
def test_many_channels_are_drawn_in_bytes_where_these_are_fast(
    name, able, drawn, dtype, monkeypatch
):
    monkeypatch.setattr(int8, "has_int8_dot_product", lambda: able)
    net = network(name).to(dtype)
    quantise_decoder_conv(net)
    assert any(isinstance(part, Int8Conv) for part in net.modules()) == drawn


@OPENVINO
def test_openvino_computes_in_bytes_what_is_to_be(unchecked):
    if not has_int8_dot_product():
        pytest.skip("this CPU has no instructions for bytes")
    live = runtime(network("setnet_in_bytes"), "openvino")
    for part in (live.runner.whole.decoder, *live.runner.decoder.compiled.values()):
        nodes = part.request.get_compiled_model().get_runtime_model().get_ordered_ops()
        told = [
            {key: node.get_rt_info()[key].astype(str) for key in ("layerType", "primitiveType")}
            for node in nodes
        ]
        in_bytes = [one["layerType"] for one in told if one["primitiveType"].endswith("I8")]
        assert in_bytes.count("Convolution") == 1
