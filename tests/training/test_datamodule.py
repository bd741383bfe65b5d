"""Batches: the same whatever the workers; going on where a training stopped; reuse; shards."""

from types import SimpleNamespace

import pytest
import torch

from src.training.augment import Augment
from src.training.batch_sampler import DrawDataset, LargeCropStream, SampleId, StepSampler
from src.training.datamodule import BatchSimulator, LightFieldData
from tests.sim.test_pipeline import STRONG, pipeline


class FakeTrainer:
    """One process whose training has gone `steps`."""

    global_rank, world_size = 0, 1

    def __init__(self, steps: int = 0):
        self.lightning_module = SimpleNamespace(steps_so_far=steps)


def chain():
    return pipeline(STRONG, sensor={"threshold": [0.1, 0.7]}, crop=16, random_crop=True)


def test_workers_change_nothing():
    def batches(workers: int) -> list[torch.Tensor]:
        data = LightFieldData(
            {"train": chain()},
            Augment(),
            batch_size=2,
            batch_reuse=2,
            epoch_clips=6,
            workers=workers,
        )
        data.trainer = FakeTrainer()
        return [batch.voxels for batch in data.train_dataloader()]

    for zero, two in zip(batches(0), batches(2), strict=True):
        assert torch.equal(zero, two)


def test_a_training_that_goes_on_sees_other_clips():
    data = LightFieldData({"train": chain()}, batch_size=2, epoch_clips=6)
    data.trainer = FakeTrainer(steps=4)
    assert next(iter(data.train_dataloader().batch_sampler)) == [(8, 8, 0), (9, 9, 0)]


def test_a_batch_used_again_is_augmented_anew():
    numbered, make = (
        DrawDataset(chain()),
        BatchSimulator([chain()], Augment(pause_probability_when_running=0.0)),
    )
    first, again, other = (
        make([numbered[SampleId(clip, number)]]) for clip, number in ((0, 0), (0, 1), (2, 2))
    )
    assert not torch.equal(first.voxels, again.voxels)
    assert first.parameters == again.parameters != other.parameters
    fresh = BatchSimulator([chain()], Augment(pause_probability_when_running=0.0))(
        [numbered[SampleId(0, 1)]]
    )
    assert torch.equal(fresh.voxels, again.voxels)


def sampler(batch_size: int, steps: int, step, **options) -> StepSampler:
    return StepSampler(batch_size=batch_size, steps_per_epoch=steps, current_step=step, **options)


def numbers(batches: StepSampler) -> list[list[int]]:
    return [[item.number for item in batch] for batch in batches]


def test_sampler_goes_on_where_the_training_stopped():
    whole = numbers(sampler(2, 4, lambda: 0))
    assert whole == [[0, 1], [2, 3], [4, 5], [6, 7]]
    assert numbers(sampler(2, 4, lambda: 3)) == whole[3:]
    assert numbers(sampler(2, 4, lambda: 4))[0] == [8, 9]


def test_reuse_repeats_clips_but_not_numbers():
    batches = list(sampler(2, 4, lambda: 0, batch_reuse=2))
    pairs = [[(item.clip, item.number) for item in batch] for batch in batches[:3]]
    assert pairs == [[(0, 0), (1, 1)], [(0, 2), (1, 3)], [(2, 4), (3, 5)]]


@pytest.mark.parametrize("world", [1, 2])
@pytest.mark.parametrize("batch_size, reuse, clips", [(3, 4, 12), (2, 4, 16), (3, 2, 24)])
def test_a_batch_used_again_leaves_no_clip_out(batch_size, reuse, clips, world):
    steps = 2 * reuse * clips
    items = []
    for rank in range(world):
        how = {"batch_reuse": reuse, "rank": rank, "world": world}
        items += [item for batch in sampler(batch_size, steps, lambda: 0, **how) for item in batch]
    assert {item.clip % clips for item in items} == set(range(clips))
    assert len({item.number for item in items}) == len(items)  # each is augmented anew


def test_processes_share_a_batch_without_overlap():
    shards = [numbers(sampler(2, 3, lambda: 0, rank=rank, world=2)) for rank in (0, 1)]
    joint = numbers(sampler(4, 3, lambda: 0))
    assert [a + b for a, b in zip(*shards, strict=True)] == joint


@pytest.mark.parametrize(
    "wrong",
    [
        {"batch_size": 0},
        {"batch_reuse": 0},
        {"epoch_clips": 3, "batch_size": 4},
        {"simulate_on": "moon"},
    ],
)
def test_wrong_values_name_their_key(wrong):
    with pytest.raises(ValueError, match=f"data.{next(iter(wrong))}"):
        LightFieldData({}, **wrong)


def test_large_batches_come_evenly_and_count_their_own():
    batches = [
        sampler(4, 100, lambda: 0, large_share=0.3, large_batch_size=2).batch(step)
        for step in range(10)
    ]
    assert [batch[0].crop_stream for batch in batches] == [0, 0, 0, 1, 0, 0, 1, 0, 0, 1]
    large = [item.clip for batch in batches for item in batch if item.crop_stream]
    assert large == [0, 1, 2, 3, 4, 5]
    usual = [item.clip for batch in batches for item in batch if not item.crop_stream]
    assert len(set(usual)) == len(usual) == 28


def test_a_large_batch_is_used_again_as_others_are():
    steps = sampler(2, 100, lambda: 0, batch_reuse=2, large_share=0.5)
    batches = [steps.batch(step) for step in range(4)]
    assert [[tuple(item) for item in batch] for batch in batches[2:]] == [[(0, 0, 1)], [(0, 1, 1)]]
    assert [[tuple(item) for item in batch] for batch in batches[:2]] == [
        [(0, 0, 0), (1, 1, 0)], [(0, 2, 0), (1, 3, 0)],
    ]  # fmt: skip


def test_batches_of_two_sizes_come_out_of_a_training():
    small, large = chain(), pipeline(STRONG, sensor={"threshold": 0.3}, crop=24, random_crop=True)
    stream = LargeCropStream(large, share=0.5, batch_size=1)
    data = LightFieldData({"train": small}, Augment(), batch_size=2, epoch_clips=8, large=stream)
    data.trainer = FakeTrainer()
    shapes = [tuple(batch.voxels.shape) for batch in data.train_dataloader()]
    assert [(shape[0], shape[-1]) for shape in shapes] == [(2, 16), (1, 24), (2, 16), (1, 24)]
    alone = BatchSimulator([small, large], Augment())(
        [DrawDataset(small, large)[SampleId(1, 1, 1)]]
    )
    again = next(b for i, b in enumerate(data.train_dataloader()) if i == 3)
    assert torch.equal(alone.voxels, again.voxels)


def test_a_share_of_large_batches_outside_its_range_is_refused():
    with pytest.raises(ValueError, match="data.large.share must be in"):
        LargeCropStream(chain(), share=1.0)
