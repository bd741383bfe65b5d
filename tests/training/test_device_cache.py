"""A cache in a device's memory: the samples of one on a disk, gathered a batch at a time."""

from weakref import ref

import pytest
import torch

from src.app import build
from src.app import simulation as simulations
from src.training.augment import Augment
from src.training.batch_sampler import DrawDataset, SampleId
from src.training.clip_cache import DeviceClipCache, simulate_clip
from src.training.datamodule import BatchSimulator
from tests.test_train import TINY, config
from tests.training.test_disk_cache import cached, disk_cache, source


def cache(clips: int = 3, gib: float = 1.0, **kwargs) -> DeviceClipCache:
    return DeviceClipCache(source(**kwargs), clips=clips, frames=7, gib=gib, device="cpu")


@pytest.mark.parametrize("views", [9, 1])
def test_its_samples_are_those_of_a_disk_bit_for_bit(views, tmp_path):
    (on_disk := disk_cache(tmp_path)).fill()
    chains = [cached(of, views=views) for of in (on_disk, cache())]
    for number in (0, 5, 200):
        disk, memory = (chain.simulate([chain.draw(number)]) for chain in chains)
        assert torch.equal(disk.voxels, memory.voxels)
        assert torch.equal(disk.target, memory.target)
        assert torch.equal(disk.turbulent, memory.turbulent)
        assert disk.parameters == memory.parameters


def test_a_batch_is_gathered_as_its_clips_are_one_by_one():
    chain = cached(cache())
    draws = [chain.draw(number) for number in range(12)]
    assert {draw.frames.step for draw in draws} == {-1, 1}
    together = chain.render_views(draws)
    assert together.dtype == torch.float16 and together.shape == (12, 9, 5, 16, 16)
    for views, draw in zip(together, draws, strict=True):
        assert torch.equal(views, chain.render_views([draw])[0])
        frames = chain.cache.clip(draw.index).views[list(draw.view_order)][:, list(draw.frames)]
        top, left, height, width = draw.crop
        assert torch.equal(views, frames[..., top : top + height, left : left + width])


@pytest.mark.parametrize("sides", [16, [8, 24]])
def test_a_batch_at_once_is_the_batch_clip_by_clip(sides):
    chain = cached(cache(), crop=sides, batch_size=4)
    items = [SampleId(number, number) for number in range(4, 8)]
    draws = [DrawDataset(chain)[item] for item in items]
    one_by_one = BatchSimulator([chain], Augment(pause_probability_when_running=0.3))(draws)
    batched = chain.simulate([draw for _, draw in draws], batched=True)
    keys = [key_of(number) for number in range(4, 8)]
    augmented = Augment(pause_probability_when_running=0.3)([batched], keys, batched=True)
    assert torch.equal(one_by_one.voxels, augmented.voxels)
    assert torch.equal(one_by_one.target, augmented.target)


def key_of(number: int) -> int:
    from src.sim import noise

    return noise.key(0, "augment", number)


def test_the_sides_of_a_range_are_a_batch_s_and_all_come():
    chain = cached(cache(), crop=[8, 24], batch_size=3)
    crops = [chain.draw(number).crop for number in range(60)]
    assert all(top + side <= 24 and left + side <= 24 for top, left, side, _ in crops)
    sides = [crop[2] for crop in crops]
    assert all(len(set(sides[batch : batch + 3])) == 1 for batch in range(0, 60, 3))
    assert set(sides) == {8, 24} and len(set(crops)) > 30


@pytest.mark.parametrize("wrong", [[24, 8], [4, 16], [16, 32], [16], [8.0, 16.0]])
def test_a_range_that_the_clips_do_not_hold_is_refused(wrong):
    with pytest.raises(ValueError, match=r"data.crop must be \[low, high\] in 8..24 .*, got \["):
        cached(cache(), crop=wrong)


def test_samples_that_come_again_keep_their_batches():
    with pytest.raises(
        ValueError, match="data.train_clips must be a multiple of data.batch_size=3"
    ):
        cached(cache(), crop=[8, 24], batch_size=3, clips=10)
    chain = cached(cache(), crop=[8, 24], batch_size=3, clips=9)
    assert [chain.draw(n).crop for n in range(9)] == [chain.draw(n).crop for n in range(9, 18)]


def test_samples_are_of_the_first_clips_only_where_fewer_came():
    of = cache(clips=50)
    for index in range(4):
        of.store(index, simulate_clip(of.source, index, "cpu"))
    of.clips = 4
    assert of.missing() == []
    assert {cached(of).draw(number).index for number in range(200)} == {0, 1, 2, 3}


def test_memory_that_is_given_back_is_filled_again():
    of = cache()
    before = cached(of).render_views([cached(of).draw(1)])
    of.clear()
    assert of.missing() == [0, 1, 2]
    assert torch.equal(cached(of).render_views([cached(of).draw(1)]), before)


def test_more_than_the_bound_is_refused():
    with pytest.raises(
        ValueError, match=r"data.cache_gib must be >= 0.08 for data.cache_clips=1000"
    ):
        cache(clips=1000, gib=0.01)


SMALL = ["scene.height=64", "scene.width=64", "data.cache_windows=4", "data.cache_crop=40"]
SMALL += [
    "data.loss_from=0",
    "data.windows=3",
    "data.crop=[16,32]",
    "turbulence=weak",
    "sensor=randomized",
    "data.cache_clips=2",
]
ONE_CLIP = ["data.cache_clips=1", "data.cache_windows=3", "data.cache_crop=32"]


def test_all_that_ask_for_the_same_share_one_of_a_process(tmp_path):
    asked = [*SMALL, *ONE_CLIP, "data.cache_device=device", "data.workers=0"]
    nine, one, other = (
        simulations.build_clip_cache(config("train", tmp_path, *asked, *more))
        for more in ([], ["optics=single", "data.crop=24"], ["seed=5"])
    )
    assert isinstance(nine, DeviceClipCache) and nine is one and nine is not other
    cfg = config("train", tmp_path, *asked)
    del cfg.trainer  # as in src.simulate like=
    assert simulations.build_clip_cache(cfg) is nine


def test_one_that_no_pipeline_has_any_more_makes_room_for_the_next(tmp_path):
    asked = [*SMALL, *ONE_CLIP, "data.cache_device=device", "data.workers=0"]
    first, second, third = (config("train", tmp_path, *asked, f"seed={n}") for n in (11, 12, 13))
    earlier = ref(simulations.build_clip_cache(first))
    used = simulations.build_pipeline(second, "train")
    assert earlier() is None
    simulations.build_clip_cache(third)
    assert simulations.build_clip_cache(second) is used.cache


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("data.cache_device=moon", "data.cache_device must be disk or device, got moon"),
        (
            "sensor.random.dark_noise_hz=[0,150]",
            "dark_noise_hz must be at most 120, .*got up to 150",
        ),
        ("data.workers=1", "data.workers must be 0 for data.cache_device=device, got 1"),
        ("data.cache_clips=null", "data.crop may be a range of sides with data.cache_clips only"),
        (
            'data.large={share:2,overrides:["data.crop=16"]}',
            r"data.large.share must be in \[0, 1\)",
        ),
        (
            'data.large={share:0.5,overrides:["data.windows=0"]}',
            "data.large: data.windows must be >",
        ),
        ("data.large={share:0.5,overrides:data.crop}", "data.large.overrides must be"),
        ("cuda_graphs=fast", "cuda_graphs must be one of auto, true, false, got fast"),
        ("cuda_graphs=true", "cuda_graphs must be auto or false without a GPU"),
    ],
)
def test_wrong_values_are_one_line(wrong, message, tmp_path):
    cfg = config("train", tmp_path, *SMALL, "data.cache_device=device", "data.workers=0", wrong)
    with pytest.raises(ValueError, match=message):
        build.build_data_module(cfg)
        build.build_reconstructor(cfg, *build.build_untrained_network(cfg))


@pytest.mark.parametrize(
    "line",
    ["augment.noise_std=99", "optimizer.lr=9", "data.test_clips=7", "data.large.foo=3", "bins=4",
     "sensor=ideal", "optics.views=3", "data.loss_from=1"],
)  # fmt: skip
def test_the_stream_of_large_crops_has_keys_of_its_clips_only(line, tmp_path):
    large = f'data.large={{share:0.5,overrides:["{line}"]}}'
    message = rf"data.large.overrides must be .* scene\.\*, .*, got {line.partition('=')[0]}$"
    with pytest.raises(ValueError, match=message):
        build.build_data_module(config("train", tmp_path, *TINY, large))


def test_a_training_of_two_sizes_takes_steps(tmp_path):
    from src.train import train

    large = '{share:0.5,overrides:["data.crop=40","data.batch_size=1","data.windows=2"]}'
    asked = [*TINY, *SMALL, "data.cache_device=device", "data.workers=0", "optics=lf2"]
    asked += [f"data.large={large}", "trainer.max_steps=4", "data.batch_size=2"]
    record = train(config("train", tmp_path, *asked, "data.epoch_clips=4"))
    assert record["test"]["clips"] > 0
