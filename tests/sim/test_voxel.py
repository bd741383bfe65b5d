"""Voxel grids against E2VID's formula written out, the direct grids, and conservation of mass."""

import inspect
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from src.sim.sensor.sensor import EventSensor
from src.sim.voxel import normalise_nonzero, voxel_grid

SIZE = dict(bins=5, height=6, width=7)


def random_events(n: int, seed: int = 0):
    g = np.random.default_rng(seed)
    t = np.sort(g.integers(1000, 9000, n))
    return t, g.integers(0, 7, n), g.integers(0, 6, n), g.choice([-1, 1], n)


def written_out(t, x, y, p, t0, t1, bins, height, width):
    """One event after the other, in float64."""
    grid = np.zeros((bins, height, width))
    for ti, xi, yi, pi in zip(t, x, y, p, strict=True):
        tau = (bins - 1) * (ti - t0) / (t1 - t0)
        for b in range(bins):
            grid[b, yi, xi] += pi * max(0.0, 1 - abs(tau - b))
    return grid


@pytest.mark.parametrize("bins", [1, 2, 5, 9])
@pytest.mark.parametrize("dtype", [np.int64, np.float64])
def test_the_grid_is_the_formula(bins, dtype):
    t, x, y, p = random_events(500)
    grid = voxel_grid(t.astype(dtype), x, y, p, t0=900, t1=9100, bins=bins, height=6, width=7)
    exact = written_out(t, x, y, p, 900, 9100, bins, 6, 7) if bins > 1 else None
    if bins == 1:
        exact = np.zeros((1, 6, 7))
        np.add.at(exact[0], (y, x), p)
    assert grid.dtype == torch.float32
    assert np.abs(grid.numpy() - exact).max() < 3e-5


def test_the_edges_of_the_window_are_the_first_and_the_last_bin():
    grid = voxel_grid([0, 100, 50], [0, 1, 2], [0, 0, 0], [1, -1, 1], t0=0, t1=100, **SIZE)
    assert grid[0, 0, 0] == 1 and grid[4, 0, 1] == -1 and grid[2, 0, 2] == 1
    assert grid.abs().sum() == 3


def test_seconds_and_microseconds_give_one_grid():
    t, x, y, p = random_events(300)
    a = voxel_grid(t, x, y, p, t0=0, t1=10000, **SIZE)
    b = voxel_grid(t * 1e-6, x, y, p, t0=0.0, t1=0.01, **SIZE)
    assert (a - b).abs().max() < 1e-4


@pytest.mark.parametrize(
    "t, p, words",
    [
        ([0.1, np.nan], [1, 1], "t must be finite, event 1 is not"),
        (np.array([1, 2], "datetime64[us]"), [1, 1], "real numbers, got datetime64"),
        ([0.1, 0.2], [1j, 1], "real numbers, got float64 and complex128"),
    ],
)
def test_times_and_polarities_are_finite_real_numbers(t, p, words):
    with pytest.raises(ValueError, match=words):
        voxel_grid(t, [1, 1], [0, 0], p, t0=0, t1=1, **SIZE)


def test_polarity_in_half_precision_counts_as_in_float32():
    t, x, y, p = random_events(300)
    grids = [
        voxel_grid(t, x, y, p.astype(kind), t0=0, t1=10000, **SIZE)
        for kind in (np.float16, np.float32)
    ]
    assert torch.equal(*grids)


@settings(max_examples=30, deadline=None)
@given(
    n=st.integers(0, 60), seed=st.integers(0, 2**31), bins=st.integers(1, 12), zero=st.booleans()
)
def test_mass_is_conserved_in_any_order(n, seed, bins, zero):
    t, x, y, p = random_events(n, seed)
    given_p = (p + 1) // 2 if zero and (p > 0).any() else p
    size = dict(bins=bins, height=6, width=7)
    grid = voxel_grid(t, x, y, given_p, t0=0, t1=10000, **size)
    order = np.random.default_rng(seed).permutation(n)
    again = voxel_grid(t[order], x[order], y[order], given_p[order], t0=0, t1=10000, **size)
    if not zero or (p > 0).any():
        assert float(grid.double().sum()) == p.sum()
    assert torch.equal(grid, again)


@pytest.mark.parametrize(
    "settings_",
    [{}, {"refractory_s": 0.0}, {"stamps": "v2e"}, {"mismatch": 0.1, "dark_noise_hz": 50.0}],
)
@pytest.mark.parametrize("fps", [120.0, 12000.0])
def test_the_list_and_the_direct_grid_are_equal(settings_, fps):
    """Law 4, exactly, over windows of one frame interval and of two."""
    frames = torch.rand(7, 16, 20, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05
    sensor = EventSensor(0.3, **settings_)
    events = sensor.events(frames, fps)
    for substeps in (1, 2):
        direct = sensor.voxels(frames[None, None], fps, substeps=substeps)[0, 0]
        for k, grid in enumerate(direct):
            t0, t1 = (math.ceil((k + i) * substeps * 1e6 / fps - 1e-6) for i in (0, 1))
            a, b = np.searchsorted(events["t"], (t0, t1))
            part = events[a:b]
            listed = voxel_grid(
                *(part[name] for name in "txyp"), t0=t0, t1=t1, bins=5, height=16, width=20
            )
            assert torch.equal(listed, grid)
            assert float(grid.double().sum()) == part["p"].sum()


def test_counts_are_those_of_the_list():
    frames = torch.rand(5, 16, 20, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05
    sensor = EventSensor(0.3)
    p = sensor.events(frames, 120.0)["p"]
    counts = sensor.counts(frames[None, None], 120.0)
    assert counts.tolist() == [[[(p == 1).sum(), (p == -1).sum()]]]


def test_counts_from_an_interval_on_are_those_of_the_rest_of_the_list():
    frames = torch.rand(7, 16, 20, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05
    sensor = EventSensor(0.3, refractory="hold", dark_noise_hz=50.0, cutoff_hz=50.0)
    events = sensor.events(frames, 120.0)
    p = events["p"][events["t"] >= 25000]
    counts = sensor.counts(frames[None, None], 120.0, first_interval=3)
    assert counts.tolist() == [[[(p == 1).sum(), (p == -1).sum()]]]


def test_normalising_is_e2vids_formula():
    t, x, y, p = random_events(40)
    grid = voxel_grid(t, x, y, p, t0=0, t1=10000, **SIZE)
    cells = grid[grid != 0]
    mean, spread = cells.mean(), cells.std(unbiased=False)
    expected = torch.where(grid != 0, (grid - mean) / spread, 0.0)
    assert torch.allclose(normalise_nonzero(grid), expected, atol=1e-5)
    assert normalise_nonzero(torch.stack([grid, grid * 0]))[1].eq(0).all()


def test_normalising_one_event_is_finite():
    grid = voxel_grid([0], [1], [1], [1], t0=0, t1=10, **SIZE)
    assert normalise_nonzero(grid).eq(0).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": [7]}, "x in 0..6"),
        ({"y": [-1]}, "y in 0..5"),
        ({"p": [2]}, "p in"),
        ({"t1": 0}, "finite t0 < t1"),
        ({"t1": math.nan}, "t0 < t1"),
        ({"x": [1, 2]}, "one length"),
        ({"bins": 0}, "bins, height, width must be whole numbers >= 1, got .0, 6, 7."),
        ({"t1": math.inf}, "finite t0 < t1"),
        ({"x": [1.5]}, "x and y must be whole numbers, got float64"),
    ],
)
def test_what_is_wrong_is_named(change, words):
    arguments = dict(t=[5], x=[1], y=[1], p=[1], t0=0, t1=10, **SIZE) | change
    with pytest.raises(ValueError, match=words):
        voxel_grid(**arguments)


def test_a_number_of_bins_that_is_not_whole_is_named():
    make = inspect.unwrap(voxel_grid)  # without the type checks of tests
    with pytest.raises(ValueError, match=r"must be whole numbers >= 1, got \(5.0, 6, 7\)"):
        make([5], [1], [1], [1], t0=0, t1=10, **SIZE | {"bins": 5.0})


def test_no_events_are_an_empty_grid():
    assert voxel_grid([], [], [], [], t0=0, t1=10, **SIZE).eq(0).all()


def test_events_that_all_lie_outside_are_told_of():
    with pytest.warns(UserWarning, match="no event lies in the window: t is 200.0 to 300.0"):
        grid = voxel_grid(
            [200.0, 300.0], [1, 2], [1, 2], [1, -1], t0=0.0, t1=0.1, bins=5, height=4, width=4
        )
    assert not grid.any()


def test_times_too_coarse_for_the_window_are_told_of():
    t = (1.6e9 + np.linspace(0, 1 / 120, 4)).astype(np.float32)
    where = {"x": [1] * 4, "y": [1] * 4, "p": [1] * 4, "t0": 1.6e9, "t1": 1.6e9 + 1 / 120}
    with pytest.warns(UserWarning, match="^t is float32, in steps of 128 at 1.6e.09: float64"):
        voxel_grid(t, **where, **SIZE)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t0": None}, "finite t0 < t1, got t0=None, t1=10"),
        ({"t0": "0"}, "finite t0 < t1, got t0='0', t1=10"),
        ({"t1": np.array([10.0])}, r"finite t0 < t1, got t0=0, t1=array\(\[10"),
        ({"t": torch.tensor([5.0], requires_grad=True)}, "^t must be an array .* requires grad"),
        ({"t": torch.tensor([5.0]).bfloat16()}, "^t must be an array that NumPy reads: .*BFloat16"),
        ({"p": np.ma.masked_array([1], [True])}, "^p must be without a mask, got a masked array"),
    ],
)
def test_what_no_grid_can_be_made_of_is_named(change, words):
    make = inspect.unwrap(voxel_grid)  # without the type checks of tests
    with pytest.raises(ValueError, match=words):
        make(**dict(t=[5], x=[1], y=[1], p=[1], t0=0, t1=10, **SIZE) | change)


def test_the_order_of_bytes_does_not_matter():
    given = {"t": [1, 5, 9], "x": [1, 2, 3], "y": [0, 1, 2], "p": [1, -1, 1]}
    swapped = {name: np.array(part, ">i4") for name, part in given.items()}
    edges = {"t0": 0, "t1": 10, **SIZE}
    assert (voxel_grid(**swapped, **edges) == voxel_grid(**given, **edges)).all()
