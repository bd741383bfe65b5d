"""The contract of a turbulence model, kept by simulated turbulence and by a class of one's own."""

import pickle

import pytest
import torch
from hydra import compose, initialize_config_dir

from src.app import simulation
from src.sim.noise import generator
from src.sim.optics import Optics, layout
from src.sim.pipeline import Pipeline, simulate
from src.sim.scenes.clip import Clip
from src.sim.sensor import EventSensor
from src.sim.turbulence.contract import ClipTurbulence, TurbulenceModel
from src.sim.turbulence.simulated import SimulatedTurbulence
from tests.conftest import ROOT


class Shift:
    """A model of one's own: every view sees the picture so many pixels to the right."""

    def draw(self, generator):
        return int(torch.randint(1, 4, (), generator=generator))

    def operator(self, drawn, *, views, height, width, fps):
        return Shifted(drawn, views)


class Shifted:
    def __init__(self, pixels, views):
        self.pixels, self.views = pixels, views

    @property
    def metadata(self):
        return {"severity": "weak", "pixels": self.pixels}

    def degrade(self, frames, generator, *, crop=None):
        moved = frames.roll(self.pixels, -1)[:, None].expand(-1, len(self.views), -1, -1, -1)
        top, left, height, width = crop
        return moved[..., top : top + height, left : left + width]

    def tilt(self, frames, generator, *, crop=None):
        push = torch.tensor([float(self.pixels), 0.0])[:, None, None]
        return push.expand(len(self.views), frames, 2, *crop[2:])


class Ramp:
    def clip(self, index):
        return Clip(torch.rand(3, 16, 16, generator=generator(index)), 120.0, "ramp")


def test_both_sides_of_the_contract_are_kept_by_simulated_turbulence():
    model = SimulatedTurbulence({"severity": "weak"})
    air = model.operator(model.draw(generator(0)), views=layout(4), height=16, width=16, fps=120.0)
    assert isinstance(model, TurbulenceModel) and isinstance(air, ClipTurbulence)
    assert air.metadata["severity"] == "weak" and air.metadata["tilt_px"] > 0


def test_a_class_of_ones_own_is_all_the_pipeline_needs():
    chain = Pipeline(Ramp(), Optics(4), Shift(), EventSensor(0.2), split="test")
    draw = pickle.loads(pickle.dumps(chain.draw(7)))
    sample = simulate(chain, [7])
    drawn = sample.parameters[0]
    assert drawn["pixels"] == draw.turbulence and drawn["severity"] == "weak"
    shown = Ramp().clip(7).frames[1:].roll(draw.turbulence, -1)
    assert torch.equal(sample.turbulent[0, :, 0], shown)


def test_wrong_options_are_refused_at_once():
    with pytest.raises(ValueError, match=r"turbulence\.tolerance must be in \(0, 1\], got 7"):
        SimulatedTurbulence({"severity": "strong"}, tolerance=7)
    with pytest.raises(ValueError, match="turbulence takes no such values.*strenght"):
        SimulatedTurbulence({"severity": "strong"}, strenght=2)
    with pytest.raises(ValueError, match=r"turbulence\.atmosphere takes no such values.*cn"):
        SimulatedTurbulence({"severity": "strong", "cn": 1}).draw(generator(0))


@pytest.fixture
def config():
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        yield lambda *overrides: compose("simulate", ["fps=120", "data.test_windows=2", *overrides])


def test_turbulence_must_name_a_class_of_an_allowed_package(config):
    cfg = config("turbulence._target_=os.system")
    with pytest.raises(ValueError, match="_target_ must be a class of"):
        simulation.build_pipeline(cfg, "test")
