"""Test clips that are simulated once for several networks: the same samples, within the memory."""

import pytest
import torch

from src.app.instantiate import build_part
from src.app.simulation import describe_test_conditions
from src.sim.pipeline import Pipeline
from src.training.batch_sampler import SampleId
from src.training.datamodule import LightFieldData
from src.training.sample_store import SampleStore, StoredSamples, count_bytes
from tests.sim.test_pipeline import STRONG, pipeline
from tests.test_train import config


@pytest.fixture
def simulated(monkeypatch) -> list[int]:
    """The numbers of the clips that were simulated."""
    numbers: list[int] = []
    original = Pipeline.simulate

    def simulate(self, draws, *rest):
        numbers.extend(draw.key for draw in draws)
        return original(self, draws, *rest)

    monkeypatch.setattr(Pipeline, "simulate", simulate)
    return numbers


def data(store: SampleStore | None = None, conditions: str = "", clips: int = 3) -> LightFieldData:
    chain = pipeline(STRONG, crop=16)
    return LightFieldData(
        {"test": chain}, test_clips=clips, test_store=store, test_conditions=conditions
    )


def test_a_second_test_simulates_nothing_and_sees_the_same(simulated):
    module = data()
    first, again = list(module.test_dataloader()), list(module.test_dataloader())
    assert len(simulated) == 3 and len(module.test_dataloader()) == 3
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one.voxels, other.voxels) and one.parameters == other.parameters


def test_another_module_of_the_same_conditions_adds_what_is_missing(simulated):
    store = SampleStore()
    few, more = (list(data(store, "a", clips).test_dataloader()) for clips in (2, 3))
    assert len(simulated) == 3
    fresh = list(data().test_dataloader())
    assert all(torch.equal(a.voxels, b.voxels) for a, b in zip(more, fresh, strict=True))
    assert few[1] is more[1]


def test_other_conditions_are_simulated_and_make_the_older_ones_give_way(simulated):
    size = count_bytes(next(iter(data().test_dataloader())))
    store = SampleStore(limit=4 * size)
    simulated.clear()
    for conditions in ("a", "b", "b", "a"):
        list(data(store, conditions).test_dataloader())
        assert store.count_bytes() <= store.limit
    assert len(simulated) == 3 + 3 + 0 + 3


def test_what_does_not_fit_is_simulated_again(simulated):
    module = data(SampleStore(limit=0))
    for _ in range(2):
        list(module.test_dataloader())
    assert len(simulated) == 6 and module.test_store.samples == {}


def test_draws_for_a_device_are_not_kept():
    store = SampleStore()
    draws = StoredSamples([SampleId(0, 0)], "a", store, lambda missing: [[n] for n in missing])
    assert list(draws) == [[SampleId(0, 0)]] and store.samples == {}


def conditions(tmp_path, *overrides: str, task: str = "eval") -> str:
    cfg = config(task, tmp_path, "data.test_clips=2", *overrides)
    return describe_test_conditions(cfg, build_part(cfg, "optics"))


@pytest.mark.parametrize(
    "other",
    [
        "turbulence=strong", "sensor.threshold=0.3", "optics=single", "fps=60", "bins=4",
        "scene.height=64", "data.test_seed=5", "data.test_windows=9", "data.test_crop=0.25",
        "data.substeps=2", "seed=9",
    ],
)  # fmt: skip
def test_whatever_makes_other_clips_is_another_condition(tmp_path, other):
    assert conditions(tmp_path, other) != conditions(tmp_path)


@pytest.mark.parametrize(
    "same", ["ckpt=setnet_small", "metrics.resolution_scale=3", "data.test_clips=5", "name=x"]
)
def test_whatever_is_of_the_network_or_its_scores_is_the_same_condition(tmp_path, same):
    assert conditions(tmp_path, same) == conditions(tmp_path)


def test_trainings_of_several_seeds_share_their_test_clips(tmp_path):
    one, other = (conditions(tmp_path, f"seed={seed}", task="train") for seed in (0, 1))
    assert one == other
