"""NaN and infinity stop a training before a step, and say how to see the clip; same bits again."""

import re
import shlex

import pytest
import torch
from omegaconf import OmegaConf

from src.app import entry_point, simulation
from src.app.simulation import merge_large_overrides
from src.sim.pipeline import Pipeline
from src.simulate import simulate
from src.train import train
from src.training.step_guard import StepGuard
from tests.test_train import TINY, config

QUICK = [*TINY, "logger=none", "optics=single", "data.epoch_clips=4", "trainer.max_steps=4"]
QUICK += ["data.batch_reuse=1"]


def poisoned(monkeypatch, clip: int, value: float, crop: float | None = None) -> None:
    """Make the simulation of one training clip, or one of this `crop`, return `value` somewhere."""
    exposed = Pipeline.simulate_sensor

    def spoil(self, draws, *args):
        sample = exposed(self, draws, *args)
        if self.split == "train" and crop in (None, self.crop):
            sample.voxels[[draw.number == clip for draw in draws], 0, 0, 0, 0, 0] = value
        return sample

    monkeypatch.setattr(Pipeline, "simulate_sensor", spoil)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_none_stops_before_the_step(value, monkeypatch, tmp_path):
    poisoned(monkeypatch, 2, value)
    run = tmp_path / "run"
    with pytest.raises(ValueError, match=r"(loss is|gradient).* at step 2, clips \[2\]") as caught:
        train(config("train", run, *QUICK, "seed=5"))
    assert "seed 5" in str(caught.value) and "'d_over_r0'" in str(caught.value)
    state = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert state["global_step"] == 2
    assert all(torch.isfinite(value).all() for value in state["state_dict"].values())
    monkeypatch.undo()
    see_the_clip(str(caught.value), tmp_path, run)


def test_of_a_large_batch_the_clip_of_its_own_stream_is_named(monkeypatch, tmp_path):
    large = "data.large={share: 0.5, overrides: ['data.crop=24', 'sensor.threshold=0.9']}"
    poisoned(monkeypatch, 0, float("nan"), crop=24)
    run = tmp_path / "run"
    wanted = r"at step 1, clips \[0\] of data.large: .* index=0 large=true$"
    with pytest.raises(ValueError, match=wanted) as caught:
        train(config("train", run, *QUICK, "data.batch_size=1", "data.crop=16", large))
    monkeypatch.undo()
    found = run_the_command(str(caught.value), tmp_path)
    other = merge_large_overrides(OmegaConf.load(run / "config.yaml"))
    pipeline = simulation.build_pipeline(other, "train")
    assert found == pipeline.simulate([pipeline.draw(0)]).parameters[0]
    usual = config("simulate", tmp_path / "usual", f"like={run}/config.yaml", "split=train")
    assert found != simulate(usual)


def run_the_command(message: str, tmp_path) -> dict:
    words = shlex.split(re.search(r"python -m src\.simulate (.*)", message).group(1))
    return simulate(config("simulate", tmp_path / "seen", *words))


@pytest.mark.parametrize(
    "given, message",
    [
        ([], "large must be false without like, got true"),
        (["like={run}/config.yaml"], "large must be false, the run of .* has no data.large"),
    ],
)
def test_large_needs_a_run_with_large_crops(given, message, tmp_path):
    cfg = config("train", tmp_path, *QUICK)
    (tmp_path / "config.yaml").write_text(entry_point.resolved_yaml(cfg))
    words = [word.format(run=tmp_path) for word in given]
    with pytest.raises(ValueError, match=message):
        simulate(config("simulate", tmp_path, "large=true", *words))


def see_the_clip(message: str, tmp_path, run) -> None:
    """Run the command that the message gives; it simulates the clip of the training."""
    found = run_the_command(message, tmp_path)
    trained = OmegaConf.load(run / "config.yaml")
    pipeline = simulation.build_pipeline(trained, "train")
    assert found == pipeline.simulate([pipeline.draw(2)]).parameters[0] and found["clip"] == 2
    assert (tmp_path / "seen" / "views.png").is_file()


def test_a_file_that_is_no_config_of_a_run_is_refused(tmp_path):
    for text in ("", "[1, 2]", "a: ]", "\x00"):
        (tmp_path / "config.yaml").write_text(text)
        with pytest.raises(ValueError, match="like must be the config.yaml"):
            simulate(config("simulate", tmp_path, f"like={tmp_path}/config.yaml"))


def test_deterministic_mode_gives_the_same_bits(tmp_path):
    states = []
    for name in ("a", "b"):
        train(config("train", tmp_path / name, *QUICK, "trainer.deterministic=true"))
        last = torch.load(tmp_path / name / "checkpoints" / "last.ckpt", weights_only=True)
        states.append(last["state_dict"])
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())


@pytest.mark.slow
def test_a_spike_of_the_loss_hardly_moves_the_weights(monkeypatch, tmp_path):
    def norms(**given) -> list[float]:
        seen = []
        step = torch.optim.Adam.step

        def watch(self, *args, **kwargs):
            gradients = [p.grad for group in self.param_groups for p in group["params"]]
            seen.append(float(torch.nn.utils.get_total_norm(gradients)))
            return step(self, *args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(torch.optim.Adam, "step", watch)
            patch.setattr(StepGuard, "gradient_scale", lambda *_: given["factor"])
            train(config("train", tmp_path / str(id(given)), *QUICK))
        return seen

    assert norms(factor=0.5)[0] == pytest.approx(0.5 * norms(factor=1.0)[0], rel=1e-5)
