"""SetNet: any views in any order, time in seconds, a clock for each cell, a state that is held."""

import inspect
import math
from itertools import pairwise

import jaxtyping
import pytest
import torch
from omegaconf import OmegaConf
from torch.utils import _pytree as pytree

from src.app import build
from src.app.instantiate import instantiate_node
from src.deploy.cost import macs_per_frame
from src.models.background import BACKGROUND, BACKGROUND_WEIGHT, blend_background
from src.models.cell_clock import (
    ACTIVITY_TAU_S,
    MIN_ACTIVITY,
    MIN_SUPPORT,
    MOVING_SHARE,
    REACH_CELLS,
    STATIC_SHARE,
)
from src.models.context_pyramid import CONTEXT_TAU_S, smooth_context
from src.models.files import load, save
from src.models.network import MAX_WINDOWS, unroll
from src.models.setnet import SIZES, SetNet
from src.models.setnet_state import SetNetState
from src.models.time_gated_memory import TimeGatedMemory
from src.sim.optics import layout
from tests.conftest import ROOT, default_dtype
from tests.test_train import config

FULL = {"bins": 5, "refine_fusion": False, "gate_rank": None}  # with what SIZES says


def small() -> SetNet:
    torch.manual_seed(0)
    network = SetNet(bins=3, channels=4, context_channels=(8, 8, 8))
    for part in (network.context.ups[0], *(block.conv2 for block in network.context.down_blocks)):
        torch.nn.init.normal_(part.weight, std=0.1)  # as after training
    return network


def voxels(n: int = 1, windows: int = 4, views: int = 9, side: int = 16) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(n, windows, views, 3, side, side, generator=generator)


def events_within(
    rows: slice, columns: slice, windows: int = 1, views: int = 2, side: int = 64
) -> torch.Tensor:
    """Voxels with events in every pixel of a block of cells and nowhere else."""
    some, block = voxels(1, windows, views, side), torch.zeros(side, side)
    rows, columns = (slice(2 * part.start, 2 * part.stop) for part in (rows, columns))
    block[rows, columns] = 1
    return (some + some.sign()) * block


def far_from(rows: slice, columns: slice, cells: int, side: int = 32) -> torch.Tensor:
    """Which cells (side, side) are farther than `cells` from a block."""
    near = torch.zeros(side, side, dtype=torch.bool)
    near[rows.start - cells : rows.stop + cells, columns.start - cells : columns.stop + cells] = 1
    return ~near


BLOCK = slice(8, 14), slice(10, 16)


@pytest.mark.parametrize(("size", "giga"), [("small", 0.34), ("medium", 1.17), ("large", 3.47)])
def test_cost_and_config_of_each_size(size, giga):
    network = SetNet.preset(size)
    assert abs(macs_per_frame(network, 176, 176, views=9) / 1e9 - giga) < 0.02
    node = OmegaConf.load(ROOT / "conf" / "model" / f"setnet_{size}.yaml")
    made = instantiate_node(OmegaConf.merge(node, {"bins": 5}))
    assert isinstance(made, SetNet) and made.init_kwargs == FULL | SIZES[size]


@pytest.mark.parametrize("size", SIZES)
def test_a_preset_is_stored_as_what_it_stands_for(size, tmp_path):
    _, spec = build.build_untrained_network(config("train", tmp_path, f"experiment=setnet_{size}"))
    assert spec == {"target": "src.models.setnet.SetNet", "kwargs": FULL | SIZES[size]}


@pytest.mark.parametrize("views", [1, 2, 3, 4, 5, 9, 16, 25])
@torch.no_grad()
def test_any_number_of_views_and_any_size(views):
    frame, state = small()(voxels(2, 1, views, 19)[:, 0], None)
    assert frame.shape == (2, 1, 19, 19) and 0 <= float(frame.min()) <= float(frame.max()) <= 1
    maps = state.hidden, state.context_average, state.context_smoothed
    channels = small().channels
    assert [tuple(part.shape[1:]) for part in maps] == [(channels, k, k) for k in (12, 6, 6)]
    scales = small().context.held_map_sizes(12, 12)
    assert [tuple(part.shape[1:]) for part in state.scales] == scales


@torch.no_grad()
def test_every_number_up_to_25_with_positions():
    network, places = small(), layout(25)
    for views in range(1, 26):
        network(voxels(1, 1, views)[:, 0], None, positions=places[:views])


@torch.no_grad()
def test_views_come_in_any_order_with_their_positions():
    network, order = small(), torch.randperm(9, generator=torch.Generator().manual_seed(3))
    places = [layout(9)[i] for i in order]
    one = two = None
    for window in voxels().unbind(1):
        straight, one = network(window, one)
        shuffled, two = network(window[:, order], two, positions=places)
    torch.testing.assert_close(straight, shuffled)


@torch.no_grad()
def test_positions_matter():
    network, window = small(), voxels()[:, 0]
    ours, _ = network(window, None)
    turned, _ = network(window, None, positions=[(col, -row) for row, col in layout(9)])
    assert float((ours - turned).abs().max()) > 1e-4


@torch.no_grad()
def test_state_stays_bounded_over_500_windows_of_noise():
    noise = torch.randn(1, 500, 2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    frames, state = unroll(small(), 30 * noise + 10)
    bounded = state.activity, state.context_recency, state.update_recency, state.hidden
    assert max(float(part.abs().max()) for part in bounded) <= 1
    assert all(torch.isfinite(part).all() for part in (frames, *pytree.tree_leaves(state)))
    assert float(state.evidence.min()) > 1  # it only grows, where everything is revealed
    # A leaky sum is at most what comes in a window divided by what leaks out of it.
    assert float(state.view_sums.abs().max()) < 4 * 3 * (10 + 30 * 6) / (1 - 0.984)


@torch.no_grad()
def test_empty_windows_hold_the_picture():
    network = small()
    _, state = unroll(network, voxels())
    nothing = torch.zeros(1, 200, 9, 3, 16, 16)
    frames, before = unroll(network, nothing[:, 1:], state)
    last, state = network(nothing[:, 0], before)
    for was, now in zip(pytree.tree_leaves(before), pytree.tree_leaves(state), strict=True):
        assert torch.equal(was, now)
    assert float((frames[:, 60] - last).abs().max()) < 1e-3
    assert float(last.std()) > 1e-3


@torch.no_grad()
def test_nothing_happens_before_the_first_event():
    frame, state = small()(torch.zeros(1, 9, 3, 16, 16), None)
    assert all(bool((part == 0).all()) for part in pytree.tree_leaves(state))
    assert torch.equal(frame, torch.full_like(frame, BACKGROUND))


def moved(before: SetNetState, after: SetNetState) -> torch.Tensor:
    """Which cells (h2, w2) of the state at half resolution differ."""
    names = "view_sums", "activity", "evidence", "hidden"
    pairs = ((getattr(before, name), getattr(after, name)) for name in names)
    return torch.stack([(a != b).flatten(0, -3).any(0) for a, b in pairs]).any(0)


@torch.no_grad()
def test_a_cell_without_supported_events_near_it_keeps_its_bits():
    network = small().eval()
    _, state = unroll(network, voxels(views=2, side=64))  # something everywhere
    nothing = torch.zeros(1, 2, 3, 64, 64)
    for _ in range(9):  # until all stands still
        _, state = network(nothing, state)
    state = state._replace(is_pending=torch.zeros_like(state.is_pending))  # no update left to do
    before, kept = state, far_from(*BLOCK, REACH_CELLS)
    for window in events_within(*BLOCK, 5).unbind(1):
        _, state = network(window, state)
    changed = moved(before, state)
    assert not changed[kept].any() and changed[~kept].all()
    new = (before.context_average != state.context_average).any((0, 1))
    assert new.any() and not new[far_from(*BLOCK, REACH_CELLS + 1)[::2, ::2]].any()


@torch.no_grad()
def test_what_a_still_camera_has_not_seen_is_exactly_the_background():
    frames, _ = unroll(small().eval(), events_within(*BLOCK, 6))
    # Evidence reaches as far as activity.
    known = far_from(*BLOCK, REACH_CELLS).repeat_interleave(2, 0).repeat_interleave(2, 1)
    unseen = frames[..., known]
    background = unseen[..., :1]  # one value for a frame
    assert torch.equal(unseen, background.expand_as(unseen))
    revealed = frames[0, -1, 0][~known]
    assert bool((revealed != background[0, -1, 0]).all())
    assert float((revealed - background[0, -1, 0]).abs().max()) > 0.01


def test_the_background_is_that_at_the_rim_of_what_is_revealed():
    pixels, revealed = torch.rand(2, 4, 40, 40), torch.zeros(2, 1, 40, 40)
    revealed[0, 0, 3:30, 5:20] = 1
    revealed[0, 0, 30] = 0.25
    bright, none = blend_background(pixels, revealed)
    weight = 40 * 0.25 * 0.75
    light = weight * pixels[0, :, 30].mean() + BACKGROUND_WEIGHT * BACKGROUND
    expected = light / (weight + BACKGROUND_WEIGHT)
    torch.testing.assert_close(bright[:, 35:], expected.expand(4, 5, 40))
    torch.testing.assert_close(bright[:, 3:30, 5:20], pixels[0, :, 3:30, 5:20])
    torch.testing.assert_close(bright[:, 30], 0.25 * pixels[0, :, 30] + 0.75 * expected)
    torch.testing.assert_close(none, torch.full_like(none, BACKGROUND))


@pytest.mark.parametrize(("cells", "is_moving"), [(11, False), (18, True)])
@torch.no_grad()
def test_a_moving_camera_updates_all_cells(cells, is_moving):
    network, block = small().eval(), (slice(4, 4 + cells), slice(4, 4 + cells))
    share = (cells + 2 * REACH_CELLS) ** 2 / 32**2
    assert share > MOVING_SHARE if is_moving else share < STATIC_SHARE
    _, state = unroll(network, voxels(views=2, side=64))
    for _ in range(9):
        _, state = network(torch.zeros(1, 2, 3, 64, 64), state)
    _, after = network(events_within(*block)[:, 0], state)
    changed, far = moved(state, after), far_from(*block, REACH_CELLS)
    assert changed[~far].all()
    assert bool(changed[far].all() if is_moving else not changed[far].any())
    held = (after.hidden == state.hidden).all(1)[0]
    assert bool(held[far].float().mean() < 0.01 if is_moving else held[far].all())


@pytest.mark.parametrize("count", [1, 40])
@torch.no_grad()
def test_a_hot_pixel_alone_activates_nothing(count):
    network, state = small().eval(), None
    hot = torch.zeros(1, 2, 3, 64, 64)
    hot[:, :, 1, 20, 20] = hot[:, :, 1, 40, 50] = count
    for _ in range(30):
        frame, state = network(hot, state)
    assert not state.activity.any() and not state.hidden.any() and not state.view_sums.any()
    assert torch.equal(frame, torch.full_like(frame, BACKGROUND))
    hot[:, :, 1, 20, 22] = MIN_SUPPORT + 1  # in the cell beside it
    _, state = network(hot, state)
    assert int(state.activity.sum()) == (2 * REACH_CELLS + 1) * (2 * REACH_CELLS + 2)


@pytest.mark.parametrize("size", SIZES)
def test_the_shipped_weights_fit(size):
    found, expected = load(f"setnet_{size}").state_dict(), SetNet.preset(size).state_dict()
    assert {k: v.shape for k, v in found.items()} == {k: v.shape for k, v in expected.items()}
    assert all(torch.isfinite(part).all() for part in found.values())


@pytest.mark.parametrize("gate_rank", [None, 3])
@torch.no_grad()
def test_a_window_cut_in_ten_passes_the_same_time(gate_rank):
    cell = TimeGatedMemory(4, gate_rank).eval()
    x, state = torch.zeros(1, 4, 8, 8), torch.rand(1, 4, 8, 8)
    cell.input_gates.weight.zero_()
    cell.state_gates.weight.zero_()  # gates do not see the state
    _, whole = cell(x, state, torch.ones(1, 1, 1, 1))
    every, last = cell(x.expand(10, -1, -1, -1), state, torch.full((10, 1, 1, 1), 0.1))
    torch.testing.assert_close(last, whole)
    torch.testing.assert_close(every[9:], whole)


@pytest.mark.parametrize("side", [16, 20, 50])
@torch.no_grad()
def test_a_sequence_at_once_is_what_its_windows_are_one_by_one(side):
    network, clips = small(), voxels(2, windows=MAX_WINDOWS + 3, side=side)
    clips[1, 4:9] = 0
    clips[0, 6:, ..., 8:] = 0  # little moves, where the picture is large
    lengths = {"window_s": torch.tensor([1 / 120, 1 / 600])}
    frames, state = unroll(network, clips, **lengths)
    alone = None
    for window, frame in zip(clips.unbind(1), frames.unbind(1), strict=True):
        expected, alone = network(window, alone, **lengths)
        torch.testing.assert_close(frame, expected, rtol=1e-4, atol=1e-5)
    for one, other in zip(state, alone, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "output_windows", [[2, 3, 17, MAX_WINDOWS + 1], [0], list(range(MAX_WINDOWS + 3))]
)
@torch.no_grad()
def test_windows_without_output_change_nothing(output_windows):
    network, clips = small(), voxels(2, windows=MAX_WINDOWS + 3)
    clips[0, 4:9] = 0
    lengths = {"window_s": torch.tensor([1 / 120, 1 / 600])}
    frames, state = unroll(network, clips, **lengths)
    some, same = unroll(network, clips, **lengths, output_windows=output_windows)
    torch.testing.assert_close(some, frames[:, output_windows], rtol=1e-4, atol=1e-5)
    for one, other in zip(state, same, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_events_count_per_time_not_per_window():
    network, seen = small(), []
    for part in (network.sum_kernels.basis, network.spread_conv.weight):
        part.zero_()  # sums leak, the longer a window the more
    network.memory.register_forward_pre_hook(lambda _, x: seen.append(x[0]))
    network(voxels()[:, 0], None, window_s=1 / 600)
    network(7 * voxels()[:, 0], None, window_s=7 / 600)
    torch.testing.assert_close(seen[0], seen[1])


@pytest.mark.parametrize("pieces", [2, 10, 100])
@pytest.mark.parametrize("events", [voxels(1, 2, 2, 64), events_within(*BLOCK, 2)])
@torch.no_grad()
def test_an_empty_window_cut_in_pieces_passes_the_same_time(events, pieces):
    network, nothing = small(), torch.zeros(1, pieces, 2, 3, 64, 64)
    _, before = unroll(network, events)
    _, whole = network(nothing[:, 0], before, window_s=0.1)
    _, cut = unroll(network, nothing, before, window_s=0.1 / pieces)
    names = "view_sums", "event_trace", "activity", "context_recency"
    for name in names if float(before.activity.mean()) < 1 else names[:3]:
        one, other = getattr(whole, name), getattr(cut, name)
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    passed_s = -0.05 * torch.log(whole.view_sums[:, :, 0] / before.view_sums[:, :, 0])
    expected = torch.full_like(passed_s, (1 - MIN_ACTIVITY) * ACTIVITY_TAU_S)
    active = (before.activity > 0).expand_as(passed_s) & (before.view_sums[:, :, 0].abs() > 0.1)
    torch.testing.assert_close(passed_s[active], expected[active], rtol=1e-2, atol=0)


@torch.no_grad()
def test_the_context_is_updated_30_times_a_second():
    network, state, kept = small().eval(), None, []
    for window in voxels(windows=10).unbind(1):
        _, state = network(window, state, window_s=1 / 120)
        kept.append((state.hidden, state.context_average))
    changed = [
        [not torch.equal(one, other) for one, other in zip(before, after, strict=True)]
        for before, after in pairwise(kept)
    ]
    assert [every[0] for every in changed] == [True] * 9  # at half resolution
    due = [window % 4 == 0 for window in range(1, 10)]  # after the first, the fifth and the ninth
    assert [every[1] for every in changed] == due


@torch.no_grad()
def test_the_context_is_a_running_mean_of_the_pyramid():
    network, windows = small().eval(), voxels(windows=9)
    outputs = []
    network.context.register_forward_hook(lambda _, x, output: outputs.append(output))
    _, state = network.sequence(windows)
    keep = torch.exp(-4 / 120 * 30 * network.context.log_rate.exp())
    new, _ = outputs[0]
    first, second, third = new[[0, 4, 8]]  # the updates
    expected = keep * (keep * first + (1 - keep) * second) + (1 - keep) * third
    torch.testing.assert_close(state.context_average[0], expected)


@torch.no_grad()
def test_the_frame_follows_the_context_smoothly():
    network, state, smoothed = small().eval(), None, []
    for window in voxels(windows=9).unbind(1):
        _, state = network(window, state)
        smoothed.append(state.context_smoothed)
    # It is updated in the first, fifth and ninth window; between, smoothing goes on.
    moved = [float((after - before).norm()) for before, after in pairwise(smoothed)]
    expected = float(torch.exp(torch.tensor(-1 / 120 / CONTEXT_TAU_S)))
    assert [b / a for a, b in pairwise(moved[3:7])] == pytest.approx([expected] * 3, rel=1e-3)
    seconds = torch.full((1, 1, 1, 1), 0.01)
    nothing, all_of_it = torch.zeros(1, 1, 1, 1), torch.ones(1, 1, 1, 1)
    halfway = smooth_context(nothing, all_of_it, seconds)
    assert torch.allclose(
        smooth_context(halfway, all_of_it, seconds), smooth_context(nothing, all_of_it, 2 * seconds)
    )
    assert torch.allclose(1 - halfway, torch.exp(-seconds / CONTEXT_TAU_S))


@torch.no_grad()
def test_a_flat_map_is_drawn_flat_up_to_the_border_without_a_pattern_of_pixels():
    network = small()
    torch.nn.init.normal_(network.pixel_conv.bias)
    flat = network.decode_logits(torch.ones(1, 4, 8, 8), torch.ones(1, 4, 4, 4))
    torch.testing.assert_close(flat, flat[:, :1, :1, :1].expand_as(flat))
    edge = network.decode_logits(torch.ones(1, 4, 8, 8).tril(), torch.ones(1, 4, 4, 4))
    assert float((edge - edge[:, :1]).abs().max()) > 1e-3


@torch.no_grad()
def test_window_length_per_clip():
    network, both = small(), voxels(2)[:, 0]
    frame, _ = network(both, None, window_s=torch.tensor([1 / 120, 1 / 600]))
    alone, _ = network(both[1:], None, window_s=1 / 600)
    torch.testing.assert_close(frame[1:], alone)


@torch.no_grad()
def test_bf16_and_channels_last_keep_the_state_in_float32():
    network = small().bfloat16().to(memory_format=torch.channels_last)
    reference, _ = unroll(small(), voxels())
    frames, state = unroll(network, voxels())
    assert {part.dtype for part in (frames, *pytree.tree_leaves(state))} == {torch.float32}
    assert float((frames - reference).abs().max()) < 0.03


def test_the_file_gives_the_network_back(tmp_path):
    spec = {"target": "src.models.setnet.SetNet", "kwargs": small().init_kwargs}
    save(tmp_path / "net.safetensors", small(), spec, {})
    again = load(tmp_path / "net.safetensors")
    assert again.views is None
    torch.testing.assert_close(
        again(voxels()[:, 0], None)[0], small()(voxels()[:, 0], None)[0], atol=2e-3, rtol=0
    )


@pytest.mark.parametrize(
    ("shape", "options", "message"),
    [
        ((1, 9, 5, 16, 16), {}, "bins must be 3"),
        ((1, 26, 3, 16, 16), {}, "views must be in 1..25"),
        ((1, 7, 3, 16, 16), {}, "views must be 1, 2"),
        ((1, 9, 3, 16, 16), {"positions": [(0, 0)]}, "positions must be 9"),
        ((0, 9, 3, 16, 16), {}, "voxels must hold one clip and one window or more"),
        ((1, 9, 3, 3, 16), {}, "voxels must be 4 px or more in height and width, got"),
        ((1, 9, 3, 16, 16), {"window_s": 0.0}, "window_s must be > 0"),
        ((2, 9, 3, 16, 16), {"window_s": torch.tensor([0.1, 0.0])}, "window_s must be > 0"),
        ((1, 9, 3, 16, 16), {"window_s": torch.tensor([math.nan])}, "window_s must be > 0"),
        ((1, 9, 3, 16, 16), {"window_s": torch.tensor([math.inf])}, "window_s must be > 0"),
    ],
)
def test_bad_input_names_its_key(shape, options, message):
    with pytest.raises(ValueError, match=message):
        small()(torch.zeros(shape), None, **options)


@pytest.mark.parametrize("window_s", [1 / 120, torch.tensor([0.01])])
@torch.no_grad()
def test_the_default_type_of_tensors_changes_nothing(window_s):
    network, windows = small().eval(), voxels()[:1]
    frames, _ = network.sequence(windows, window_s=window_s)
    with default_dtype(torch.float64):
        assert torch.equal(network.sequence(windows, window_s=window_s)[0], frames)


def test_another_shape_is_refused_in_one_line():
    forward = inspect.unwrap(SetNet.forward)  # without the type checks of tests
    with pytest.raises(ValueError, match=r"^voxels must be \(clips, .* got \(1, 1, 5, 48\)$"):
        forward(small(), torch.zeros(1, 1, 5, 48))


def test_a_state_of_another_size_is_refused(monkeypatch):
    network = small()
    _, state = network(voxels()[:, 0], None)
    with pytest.raises(ValueError, match="state must have sizes"):
        network(voxels(side=24)[:, 0], state)
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match="^state must be the second of the two that a network re"):
        network(voxels()[:, 0], network(voxels()[:, 0], None))


@pytest.mark.parametrize("wrong", [[(0, 0), (0, 0)], [(0, 0), (0, 0.5)], [(0, 0), (0, 99)], 9])
def test_positions_that_are_none_are_refused(wrong):
    check = inspect.unwrap(SetNet.checked_positions)  # without the type checks of tests
    with pytest.raises(ValueError, match="positions"):
        check(SetNet(channels=4), 2, 5, wrong)
