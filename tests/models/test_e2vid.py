"""E2VID: published sizes, any frame size, pure state, spectral norm, learning."""

import inspect
import math

import numpy as np
import pytest
import torch
from jaxtyping import config
from torch.nn.utils import parametrize

from src.deploy.cost import macs_per_frame
from src.models.e2vid import E2VID
from src.models.network import check_voxel_shape, unroll
from src.sim.optics import layout


@pytest.mark.parametrize(
    ("kwargs", "parameters"),
    [
        ({}, 10_710_401),
        ({"views": 9}, 10_742_401),
        ({"recurrent": "convgru"}, 9_161_665),
        ({"base_channels": 16}, 2_679_489),
        ({"base_channels": 8}, 670_817),
        ({"kernel_size": 3}, 9_331_585),
        ({"views": 9, "base_channels": 8, "stem_channels": 32}, 708_153),
    ],
)
def test_published_parameter_counts(kwargs, parameters):
    assert sum(p.numel() for p in E2VID(**kwargs).parameters()) == parameters


@pytest.mark.parametrize(("views", "giga"), [(1, 14.07), (9, 15.06)])
def test_published_cost_at_176(views, giga):
    assert abs(macs_per_frame(E2VID(views), 176, 176, views=views) / 1e9 - giga) < 0.01


def small(**kwargs) -> E2VID:
    torch.manual_seed(0)
    return E2VID(**{"views": 2, "bins": 3, "base_channels": 4} | kwargs)


def voxels(n: int = 2, windows: int = 4, side: int = 16) -> torch.Tensor:
    return torch.randn(n, windows, 2, 3, side, side, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("size", [(16, 16), (17, 23), (30, 9)])
@torch.no_grad()
def test_any_size_comes_back(size):
    frame, state = small()(torch.randn(1, 2, 3, *size), None)
    assert frame.shape == (1, 1, *size) and 0 <= float(frame.min()) <= float(frame.max()) <= 1
    assert len(state) == 3


@torch.no_grad()
def test_no_activation_is_unbounded():
    network = small(final_activation="none")
    assert float(network(50 * torch.randn(1, 2, 3, 16, 16), None)[0].min()) < 0


@pytest.mark.parametrize("state_rounding_step", [None, 0.25])
@torch.no_grad()
def test_windows_without_output_warm_up_the_state(state_rounding_step):
    network, drawn = small(state_rounding_step=state_rounding_step).eval(), []
    network.pred.register_forward_hook(lambda *_: drawn.append(1))
    windows = voxels().repeat(1, 3, 1, 1, 1, 1)
    whole, state = unroll(network, windows)
    drawn.clear()
    some, same = unroll(network, windows, output_windows=[1, 4])
    assert torch.equal(some, whole[:, [1, 4]]) and len(drawn) == 2
    for ours, theirs in zip(same, state, strict=True):
        assert all(map(torch.equal, ours, theirs))


@torch.no_grad()
def test_less_than_half_a_step_is_not_handed_on():
    network, window = small(state_rounding_step=0.25).eval(), voxels()[:, 0]
    _, state = network(window, None)
    (hidden, memory), *rest = state
    steps = 0.25 * (hidden / 0.25).round()
    jitter = 0.12 * torch.rand_like(hidden).mul(2).sub(1)
    frame = network(window, state)[0]
    assert torch.equal(frame, network(window, ((steps + jitter, memory), *rest))[0])
    assert not torch.equal(frame, small().eval()(window, state)[0])


@torch.no_grad()
def test_training_sees_the_hidden_map_as_it_is():
    network, window = small(state_rounding_step=0.25), voxels()[:, 0]
    _, state = network(window, None)
    assert torch.equal(network(window, state)[0], small()(window, state)[0])


def test_views_are_stacked_view_by_view():
    network = small()
    one = torch.zeros(1, 2, 3, 16, 16)
    one[:, 1, 2] = 1.0
    assert torch.equal(one.flatten(1, 2)[:, 5], torch.ones(1, 16, 16))
    assert network.head.in_channels == 6


@pytest.mark.parametrize("shape", [(1, 1, 3, 16, 16), (1, 2, 5, 16, 16)])
def test_other_views_or_bins_are_refused(shape):
    with pytest.raises(ValueError, match=r"^views, bins must be \(2, 3\) .*optics.views, bins"):
        small()(torch.zeros(shape), None)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"positions": layout(2)[::-1]}, r"^positions must be in the order \[\(0, 0\), \(0, 1\)\]"),
        ({"positions": [(7, 7)] * 3}, r"^positions must be 2 \(row, col\), one .*, got 3"),
        ({"window_s": -1.0}, "^window_s must be > 0 seconds, got -1.0"),
        ({"window_s": math.nan}, "^window_s must be > 0 seconds, got nan"),
        ({"window_s": torch.tensor([0.1, 0.0])}, "^window_s must be > 0 seconds, got .*0.0"),
    ],
)
def test_positions_and_windows_that_do_not_fit_are_refused(options, message):
    network, windows = small(), voxels()
    for call in (network, network.warm_up):
        with pytest.raises(ValueError, match=message):
            call(windows[:, 0], None, **options)
    with pytest.raises(ValueError, match=message):
        network.sequence(windows, **options)


@torch.no_grad()
def test_positions_of_any_spacing_and_length_of_window_change_nothing():
    network, window = small(), voxels()[:, 0]
    frame, _ = network(window, window_s=0.3, positions=[(2, -3), (2, 5)])
    assert torch.equal(frame, network(window)[0])
    down = network(window, positions=[(-1, 0), (0, 0)])[0]  # as it may be trained
    assert torch.equal(frame, down)


@pytest.mark.parametrize("kind", [torch.float64, torch.int64, torch.bfloat16])
@torch.no_grad()
def test_grids_of_any_number_type_are_taken(kind):
    network, window = small(), (3 * voxels()[:, 0]).round()
    forward = inspect.unwrap(E2VID.forward)  # without the type checks of tests
    assert torch.equal(forward(network, window.to(kind))[0], network(window)[0])


def test_another_shape_is_refused_in_one_line():
    forward = inspect.unwrap(E2VID.forward)  # without the type checks of tests
    with pytest.raises(ValueError, match=r"^voxels must be \(clips, .* got \(1, 2, 3, 16\)$"):
        forward(small(), torch.zeros(1, 2, 3, 16))


def test_positions_that_are_none_are_refused(monkeypatch):
    monkeypatch.setattr(config, "jaxtyping_disable", True)
    with pytest.raises(
        ValueError, match=r"^positions must be the \(row, col\) of each view, got 9"
    ):
        small()(voxels()[:, 0], None, positions=9)


@pytest.mark.parametrize("size", [(1, 16), (16, 3), (0, 16)])
def test_a_side_that_cannot_be_padded_is_refused(size):
    with pytest.raises(ValueError, match=r"^voxels must be 4 px or more in height and width, got"):
        small()(torch.zeros(1, 2, 3, *size), None)
    assert small()(torch.zeros(1, 2, 3, 4, 5), None)[0].shape == (1, 1, 4, 5)


@pytest.mark.parametrize("window_s", [8333, torch.tensor([8333.0])])
def test_a_window_in_microseconds_is_told_of(window_s):
    with pytest.warns(UserWarning, match="^a window lasts 8333 s: is window_s in seconds"):
        small()(voxels()[:, 0], window_s=window_s)


def test_an_array_is_refused_in_one_line():
    check = inspect.unwrap(check_voxel_shape)  # without the type checks of tests
    with pytest.raises(ValueError, match=r"^voxels must be a tensor, got ndarray$"):
        check(np.zeros((1, 2, 3, 16, 16), np.float32))


@pytest.mark.parametrize("recurrent", ["convlstm", "convgru"])
@pytest.mark.parametrize("shape", [(2, 4, 2, 3, 24, 16), (3, 4, 2, 3, 16, 16)])
def test_a_state_of_another_size_is_refused(recurrent, shape):
    network = small(recurrent=recurrent)
    _, state = network(voxels()[:, 0], None)
    network(voxels()[:, 1], state)
    with pytest.raises(ValueError, match="^state must be the second of the two that a network re"):
        network(voxels()[:, 1], network(voxels()[:, 0], None))
    for call in (network, network.warm_up):
        for wrong in (state, 5):
            with pytest.raises(ValueError, match=r"^state must have sizes \[\(., 8, .*, got"):
                call(torch.zeros(shape)[:, 0], wrong)


@pytest.mark.parametrize("wrong", [{"recurrent": "lstm"}, {"final_activation": "tanh"}])
def test_unknown_choices_name_their_key(wrong):
    with pytest.raises(ValueError, match=f"model.{next(iter(wrong))}"):
        E2VID(**wrong)
    with pytest.raises(ValueError, match="model.kernel_size"):
        E2VID(kernel_size=4)


def test_spectral_norm_keeps_the_gates_at_one():
    network = small(spectral_norm=True)
    for _ in range(30):  # power iterations
        unroll(network, voxels())
    network.eval()
    for cell in network.cells:
        sigma = torch.linalg.matrix_norm(cell.gates.weight.detach().flatten(1), 2)
        assert abs(float(sigma) - 1) < 1e-3


def test_spectral_norm_is_computed_once_in_a_cached_unroll():
    network = small(spectral_norm=True).train()
    gate = network.cells[0].gates
    with parametrize.cached():
        assert gate.weight is gate.weight
