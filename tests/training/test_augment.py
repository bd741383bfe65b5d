"""The semantics of every augmentation on hand-made sequences."""

import math
from collections import Counter
from dataclasses import dataclass

import pytest
import torch

from src.sim.optics import layout
from src.sim.pipeline import Sample, concatenate_samples
from src.training.augment import (
    Augment,
    draw_flip_axes,
    draw_kept_views,
    draw_pauses,
    draw_view_shifts,
    flipped_view_order,
)
from src.training.clip_transforms import flip_frames, shift_views
from src.training.voxel_noise import add_firing_pixels, draw_normals, draw_pixel_offsets

OFF = {
    "noise_std": 0.0,
    "max_offset_pixel_fraction": 0.0,
    "pause_probability_when_running": 0.0,
    "flip_probability": 0.0,
}


def numbered(windows: int = 6, size: int = 4) -> Sample:
    """A sample whose voxels and target say which window and pixel they come from."""
    window = torch.arange(1.0, windows + 1).reshape(1, windows, 1, 1, 1, 1)
    pixel = torch.arange(size * size).reshape(size, size) / 100
    voxels = (window + pixel).expand(1, windows, 2, 3, size, size)
    target = voxels[:, :, 0, :1] / 10
    return Sample(voxels.clone(), target.clone(), target.clone(), torch.tensor([1 / 120]))


@dataclass(frozen=True)
class Scaled(Augment):
    gain: float = 3.0


def test_a_subclass_has_fields_of_any_range():
    assert Scaled(**OFF).gain == 3
    with pytest.raises(ValueError, match=r"augment.flip_probability must be in \[0, 1\], got 2"):
        Scaled(flip_probability=2)


def test_nothing_on_changes_nothing():
    sample = numbered()
    out = Augment(**OFF)([sample], [1])
    assert torch.equal(out.voxels, sample.voxels) and torch.equal(out.target, sample.target)


def test_a_pause_repeats_the_target_without_events_and_the_clip_goes_on():
    out = Augment(
        **OFF | {"pause_probability_when_running": 0.5, "pause_probability_when_paused": 0.5}
    )([numbered(40)], [3])
    steps, paused = draw_pauses(40, 0.5, 0.5, key_of(3))
    assert 5 < int(paused.sum()) < 35 and not paused[0]
    for step in range(40):
        shown = float(steps[step]) + 1
        assert torch.all((out.target[0, step] * 10).floor() == shown)
        if paused[step]:
            assert torch.all(out.voxels[0, step] == 0) and steps[step] == steps[step - 1]
        else:
            assert torch.all(out.voxels[0, step].floor() == shown)
            assert step == 0 or steps[step] == steps[step - 1] + 1


def key_of(key: int) -> int:
    from src.sim import noise

    return noise.key(key, "pause")


def test_draw_pauses_has_the_paper_s_rates():
    chains = [draw_pauses(200, 0.05, 0.9, key)[1] for key in range(100)]
    paused = torch.stack(chains)[:, 60:].double()  # the chain forgets its start
    # Stationary share 0.05 / (0.05 + 0.1); neighbours are correlated by 0.85 per step.
    spread = math.sqrt(1 / 3 * 2 / 3 / paused.numel() * (1 + 0.85) / (1 - 0.85))
    assert abs(float(paused.mean()) - 1 / 3) < 4 * spread


def test_flips_turn_voxels_and_targets_alike():
    sample = numbered()
    seen = set()
    for key in range(40):
        out = Augment(**OFF | {"flip_probability": 0.5})([sample], [key])
        axes = [a for a in ([], [-1], [-2], [-2, -1]) if torch.equal(out.voxels, turn(sample, a))]
        assert len(axes) == 1
        expected = sample.target.flip(axes[0]) if axes[0] else sample.target
        assert torch.equal(out.target, expected) and torch.equal(out.turbulent, expected)
        seen.add(tuple(axes[0]))
    assert len(seen) == 4


@pytest.mark.parametrize("views", [1, 2, 3, 4, 5, 9, 25])
def test_views_of_a_grid_turn_with_their_pictures(views):
    """A light field whose views see a slope according to their position still does when turned."""
    rows, columns = torch.tensor(layout(views)).float().T
    y, x = torch.meshgrid(torch.arange(6.0), torch.arange(6.0), indexing="ij")
    down, across = (place[:, None, None] - place.mean() for place in (rows, columns))
    field = down * (y - 2.5) + across * (x - 2.5)
    for axes in ([], [-1], [-2], [-2, -1]):
        order = flipped_view_order(layout(views), axes)
        assert torch.allclose(flip_frames(field[order], axes), field)


def test_the_centre_view_stays_the_centre_view():
    for axes in ([], [-1], [-2], [-2, -1]):
        assert flipped_view_order(layout(9), axes)[4] == 4


def turn(sample: Sample, axes: list[int]) -> torch.Tensor:
    return sample.voxels.flip(axes) if axes else sample.voxels


def test_flip_probabilities():
    assert draw_flip_axes(1.0, 5) == [-2, -1] and draw_flip_axes(0.0, 5) == []


def test_noise_has_the_stated_spread_also_in_pauses():
    sample = Sample(
        torch.zeros(1, 20, 3, 5, 32, 32),
        torch.zeros(1, 20, 1, 32, 32),
        torch.zeros(1, 20, 1, 32, 32),
        window_s=torch.tensor([1 / 120]),
    )
    out = Augment(**OFF | {"noise_std": 0.4, "pause_probability_when_running": 1.0})(
        [sample], [1]
    ).voxels
    assert abs(float(out.std()) - 0.4) < 5 * 0.4 / math.sqrt(2 * out.numel())
    assert float(out[0, 5].std()) > 0.3


def test_normals_are_normal_and_each_its_own():
    seen = draw_normals((100_000, 7), 5, torch.device("cpu")).double()
    for power, moment in ((1, 0), (2, 1), (3, 0), (4, 3), (6, 15)):
        spread = math.sqrt(math.prod(range(2 * power - 1, 0, -2)) / seen.numel())
        assert abs(float((seen**power).mean()) - moment) < 5 * spread
    for shift in (1, 4, 7):  # neighbours, those of one word, and of one row
        flat = seen.flatten()
        assert abs(float((flat[shift:] * flat[:-shift]).mean())) < 5 / math.sqrt(seen.numel())
    assert not torch.equal(seen, draw_normals((100_000, 7), 6, torch.device("cpu")).double())
    assert torch.equal(seen, draw_normals((100_000, 7), 5, torch.device("cpu")).double())


def test_hot_pixels_stay_through_the_sequence():
    sample = numbered(windows=5, size=64)
    out = Augment(**OFF | {"max_offset_pixel_fraction": 0.02})([sample], [2]).voxels
    added = out - sample.voxels
    assert torch.allclose(added, added[:, :1, :1, :1].expand_as(added), atol=1e-5)
    assert 0 < int((added[0, 0, 0, 0].abs() > 1e-4).sum()) <= 0.02 * 64 * 64


def test_hot_pixel_count_is_uniform_up_to_the_fraction():
    counts = [int((draw_pixel_offsets((50, 50), 0.01, key) != 0).sum()) for key in range(400)]
    assert max(counts) <= 25
    assert abs(sum(counts) / 400 - 12.5) < 4 * 25 / math.sqrt(12 * 400)


def test_small_crops_have_a_hot_pixel_as_often_as_their_part_of_one_is_large():
    counts = [int((draw_pixel_offsets((64, 64), 1e-4, key) != 0).sum()) for key in range(2000)]
    assert max(counts) == 1
    assert abs(sum(counts) / 2000 - 0.2048) < 4 * math.sqrt(0.2 * 0.8 / 2000)


def test_small_crops_have_a_firing_pixel_as_often_too():
    voxels = torch.zeros(1, 2, 1000, 1, 64, 64)  # each view draws its own
    add_firing_pixels(voxels, 1e-4, [(1000.0, 1000.0)], [0])
    counts = (voxels[0] != 0).any(0).sum((1, 2, 3))
    assert counts.max() == 1
    assert abs(float(counts.float().mean()) - 0.2048) < 4 * math.sqrt(0.2 * 0.8 / 1000)


def test_firing_pixels_come_and_go_at_their_rate_each_view_s_own(monkeypatch):
    monkeypatch.setattr("src.training.augment.NOISY_PIXEL_RATE_HZ", (600.0, 600.0))
    sample = numbered(windows=40, size=64)
    out = Augment(**OFF | {"max_firing_pixel_fraction": 0.1})([sample], [2]).voxels
    added = (out - sample.voxels)[0].round()  # (windows, views, bins, h, w)
    fires = (added != 0).any(2).any(0)  # (views, h, w)
    shares = fires.float().mean((1, 2))
    assert 0 < float(shares.max()) <= 0.1 and not torch.equal(*fires)
    # ON less OFF of two Poisson processes: the variance is the number of events, 5 a window
    spread = added.sum(2).movedim(0, -1)[fires].square().mean()
    assert abs(float(spread) - 5) < 0.3
    assert abs(float(added[:, fires[:, None].expand_as(added[0])].mean())) < 0.05


def test_a_clip_is_augmented_the_same_in_any_batch():
    clip, augment = numbered(), Augment()
    together, alone = augment([clip, clip], [5, 6]), augment([clip], [6])
    assert torch.equal(together.voxels[1], alone.voxels[0])


def test_a_misplaced_view_moves_whole_and_leaves_nothing_behind():
    view = torch.zeros(2, 3, 1, 16, 16)
    view[..., 8, 8] = 1
    moved = shift_views(view.clone(), draw_view_shifts(3, 1.0, 2, key=4))
    places = [tuple(moved[0, i, 0].nonzero()[0].tolist()) for i in range(3)]
    assert float(moved.sum()) == float(view.sum()) and torch.equal(moved[0], moved[1])
    assert len(set(places)) > 1 and all(abs(axis - 8) <= 2 for place in places for axis in place)
    assert torch.equal(shift_views(view.clone(), draw_view_shifts(3, 0.0, 2, key=4)), view)


@pytest.mark.parametrize(("views", "is_shifted"), [(1, False), (2, False), (3, True)])
def test_only_a_view_that_others_tell_to_be_displaced_is_shifted(views, is_shifted):
    voxels = torch.rand(1, 6, views, 5, 16, 16)
    frames = torch.rand(1, 6, 1, 16, 16)
    sample = Sample(voxels, frames, frames, torch.tensor([1 / 120]), layout(views), [{}])
    off = {"noise_std": 0.0, "max_offset_pixel_fraction": 0.0, "flip_probability": 0.0}
    off |= {"pause_probability_when_running": 0.0}
    shifted = Augment(**off, view_shift_probability=1.0, max_view_shift_px=3)([sample], [5])
    assert torch.equal(shifted.target, frames)
    assert torch.equal(shifted.voxels, voxels) is not is_shifted


def test_shifting_brings_nothing_in():
    moved = shift_views(torch.ones(1, 9, 5, 8, 8), [(2, 1, -2)])
    assert moved[:, 2].sum() == 5 * 7 * 6 and moved[:, 3].all()
    assert not moved[0, 2, 0, 0].any() and not moved[0, 2, 0, :, -2:].any()


def test_dropped_views_take_their_positions_along_and_some_view_stays():
    places = tuple((0, column) for column in (-1, 0, 1, 2))
    voxels = torch.arange(4.0).reshape(1, 1, 4, 1, 1, 1)
    picture = torch.zeros(1, 1, 1, 1, 1)
    sample = Sample(voxels, picture, picture, torch.tensor([1 / 120]), places)
    lossy = Augment(**OFF, batch_view_dropout_probability=1.0)
    counts = Counter()
    for key in range(200):
        left = lossy([sample], [key])
        kept = left.voxels.flatten().tolist()
        assert [places[int(view)] for view in kept] == list(left.positions)
        counts[len(kept)] += 1
        assert len(kept) > 1 or kept == [1]
    assert set(counts) == {1, 2, 3} and counts[1] > counts[2] > counts[3]
    assert draw_kept_views(places, 0.0, 0.0, 1) == [0, 1, 2, 3]
    drawn = [draw_kept_views(places, 0.5, 0.25, key) for key in range(800)]
    assert 330 < drawn.count([1]) < 415  # of 800 * (0.25 + 0.75 * 0.5 * 0.577)
    assert 250 < drawn.count([0, 1, 2, 3]) < 350  # of 800 * (1 - 0.25) * (1 - 0.5)
    assert all(draw_kept_views(places, 0.0, 1.0, key) == [1] for key in range(20))


def test_a_view_that_stays_shows_the_picture_of_its_turned_place():
    voxels = torch.arange(9.0).reshape(1, 1, 9, 1, 1, 1)
    picture = torch.zeros(1, 1, 1, 1, 1)
    sample = Sample(voxels, picture, picture, torch.tensor([1 / 120]), layout(9))
    mirror = Augment(**OFF | {"flip_probability": 1.0}, batch_view_dropout_probability=1.0)
    for key in range(10):
        left = mirror([sample], [key])
        shown = [layout(9)[int(view)] for view in left.voxels.flatten()]
        assert shown == [(-row, -column) for row, column in left.positions]


@pytest.mark.parametrize(
    "wrong",
    [
        {"flip_probability": 1.5},
        {"pause_probability_when_running": -0.1},
        {"noise_std": -1},
        {"max_offset_pixel_fraction": 2},
        {"view_shift_probability": 2},
        {"max_view_shift_px": -1},
        {"batch_view_dropout_probability": 1.5},
        {"batch_centre_view_probability": 1.5},
        {"max_firing_pixel_fraction": -1},
    ],
)
def test_wrong_values_name_their_key(wrong):
    with pytest.raises(ValueError, match=f"augment.{next(iter(wrong))}"):
        Augment(**wrong)


def drawn_batch(clips: int, seed: int = 0, teacher_frames: bool = False) -> list[Sample]:
    """Samples of a clip each, whose numbers are all different."""
    drawer = torch.Generator().manual_seed(seed)
    made = []
    for clip in range(clips):
        voxels = torch.randn(1, 7, 9, 2, 16, 16, generator=drawer)
        target, turbulent, other = torch.rand(3, 1, 7, 1, 16, 16, generator=drawer)
        window_s, drawn = torch.tensor([1 / (120 * (clip + 1))]), [{"clip": clip}]
        extra = {"teacher_frames": other} if teacher_frames else {}
        made.append(Sample(voxels, target, turbulent, window_s, parameters=drawn, **extra))
    return made


STRONG = {
    "pause_probability_when_running": 0.3,
    "max_offset_pixel_fraction": 0.02,
    "max_firing_pixel_fraction": 0.05,
}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"view_shift_probability": 0.5},
        {"batch_view_dropout_probability": 1.0, "view_shift_probability": 1.0},
    ],
)
@pytest.mark.parametrize("teacher_frames", [False, True])
def test_a_batch_at_once_is_the_clips_one_by_one(changes, teacher_frames):
    samples, keys = drawn_batch(6, teacher_frames=teacher_frames), list(range(40, 46))
    augment = Augment(**STRONG | changes)
    apart, together = (augment(samples, keys, batched=batched) for batched in (False, True))
    assert torch.equal(apart.voxels, together.voxels)
    assert torch.equal(apart.target, together.target)
    assert torch.equal(apart.turbulent, together.turbulent)
    assert (apart.teacher_frames is None) == (not teacher_frames)
    assert not teacher_frames or torch.equal(apart.teacher_frames, together.teacher_frames)
    assert apart.positions == together.positions and apart.parameters == together.parameters


def test_one_sample_of_many_clips_is_as_many_samples_of_one():
    samples, keys = drawn_batch(3), [7, 8, 9]
    for batched in (False, True):
        apart = Augment(**STRONG)(samples, keys, batched=batched)
        whole = Augment(**STRONG)([concatenate_samples(samples)], keys, batched=batched)
        assert torch.equal(apart.voxels, whole.voxels) and torch.equal(apart.target, whole.target)
