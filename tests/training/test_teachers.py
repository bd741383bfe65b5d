"""Teachers: the mean picture of frozen networks, once for each sample, as a second target."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from src.app import build
from src.losses.terms import Distillation, TrainingLoss
from src.models.e2vid import E2VID
from src.models.network import EventToVideoNetwork
from src.models.setnet import SetNet
from src.sim.pipeline import simulate
from src.training import teachers as module
from src.training.augment import Augment
from src.training.batch_sampler import SampleId
from src.training.datamodule import BatchSimulator
from src.training.teachers import TeacherEnsemble
from tests.sim.test_pipeline import STRONG, pipeline
from tests.test_train import config
from tests.training.test_reconstructor import Leaky, SquaredError, fit, sample

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`")


class Constant(EventToVideoNetwork):
    """Draws one grey, whatever comes in and however long it lasts."""

    views = None

    def __init__(self, grey: float):
        super().__init__()
        self.grey, self.windows = nn.Parameter(torch.tensor(grey)), []

    @property
    def calls(self):
        return len(self.windows)

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        self.windows.append(window_s)
        return self.grey.expand(len(voxels), 1, *voxels.shape[-2:]), state


@pytest.fixture(scope="module")
def clip():
    return simulate(pipeline(STRONG, crop=16), [0])


def test_the_picture_is_the_mean_of_the_networks_to_8_bits(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "is_bf16_faster", lambda: False)
    networks = {"one": SetNet(channels=8, context_channels=[8]), "two": Constant(0.3)}
    teacher_frames = TeacherEnsemble(networks, tmp_path, 120.0)(clip)
    with torch.no_grad():
        expected = torch.stack([net.reconstruct_clip(clip) for net in networks.values()]).mean(0)
    assert teacher_frames.shape == clip.target.shape
    assert (teacher_frames - expected).abs().max() <= 0.5 / 255 + 1e-6


def test_a_picture_is_made_once_and_again_where_anything_differs(clip, tmp_path):
    network = Constant(0.25)
    first = TeacherEnsemble({"a": network}, tmp_path, 120.0)(clip, 0)
    made = network.calls
    assert torch.equal(TeacherEnsemble({"b": network}, tmp_path, 120.0)(clip, 0), first)
    assert network.calls == made
    TeacherEnsemble({"a": network}, tmp_path, 120.0)(replace(clip, voxels=clip.voxels + 1), 0)
    assert network.calls == 2 * made
    assert not torch.equal(TeacherEnsemble({"a": Constant(0.75)}, tmp_path, 120.0)(clip, 0), first)
    (path, *_) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:100])
    TeacherEnsemble({"a": Constant(0.5)}, tmp_path, 120.0)(clip, 0)  # others beside it do no harm
    assert torch.equal(TeacherEnsemble({"a": network}, tmp_path, 120.0)(clip, 0), first)


def test_networks_of_the_same_weights_and_other_arguments_share_no_picture(clip, tmp_path):
    torch.manual_seed(0)
    first = E2VID(base_channels=4)
    clip = replace(clip, voxels=clip.voxels[:, :, :1], positions=[(0, 0)])
    frames = []
    for arguments in ({}, {"state_rounding_step": 0.25}, {"final_activation": "none"}):
        network = E2VID(base_channels=4, **arguments)
        network.load_state_dict(first.state_dict())
        frames.append(TeacherEnsemble({"net": network}, tmp_path, 120.0)(clip, 0))
    assert len(list(tmp_path.iterdir())) == 3
    assert not torch.equal(frames[0], frames[2])


@pytest.mark.parametrize(
    "settings, repeats",
    [
        ({"clips": 2}, True),
        ({"clips": None}, False),
        ({"clips": 2, "crop": 16, "random_crop": True}, False),
    ],
)
def test_only_samples_that_come_again_are_kept(settings, repeats, tmp_path):
    chain, network = pipeline(STRONG, **{"crop": 16} | settings), Constant(0.25)
    teachers = TeacherEnsemble({"a": network}, tmp_path, 120.0)
    simulate_batch = BatchSimulator([chain], teachers=teachers)
    for number in (0, 1, 2):
        sample = simulate_batch([(SampleId(number, number), chain.draw(number))])
        assert (sample.teacher_frames - 0.25).abs().max() < 1 / 255
    assert len(list(tmp_path.iterdir())) == len(teachers.paths) == (2 if repeats else 0)
    assert network.calls == len(sample.target[0]) * (2 if repeats else 3)


def test_a_sample_that_comes_again_by_name_is_not_hashed_again(clip, tmp_path, monkeypatch):
    teachers = TeacherEnsemble({"a": Constant(0.25)}, tmp_path, 120.0)
    first = teachers(clip, "its name")
    monkeypatch.setattr(module, "_hash", lambda *_: pytest.fail("hashed again"))
    assert torch.equal(teachers(clip, "its name"), first)


def test_who_is_not_told_the_length_of_windows_teaches_those_it_knows(clip, tmp_path):
    networks = {"told": SetNet(channels=8, context_channels=[8]), "not": Constant(0.3)}
    fast = replace(clip, window_s=clip.window_s / 4)
    both = TeacherEnsemble(networks, tmp_path, 120.0)
    told = TeacherEnsemble({"told": networks["told"]}, tmp_path, 120.0)
    assert torch.equal(both(fast), told(fast))
    assert not torch.equal(both(clip), told(clip))
    with pytest.raises(ValueError, match="teachers must have one .* 480 windows a second, got not"):
        TeacherEnsemble({"not": networks["not"]}, tmp_path, 120.0, (120.0, 480.0))


def test_what_is_taught_turns_and_pauses_with_the_truth(clip):
    taught = replace(clip, teacher_frames=clip.target)
    batch = Augment(pause_probability_when_running=0.5)([taught] * 6, range(6))
    assert torch.equal(batch.teacher_frames, batch.target)
    assert not torch.equal(batch.target[0], batch.target[1])


def test_what_is_taught_is_added_to_the_loss(monkeypatch, weight=3.0):
    plain, other = sample(), torch.rand(2, 6, 1, 8, 8)
    mixed = replace(plain, target=(plain.target + weight * other) / (1 + weight))
    fitted = []
    for batch, lr, distillation in (
        (replace(plain, teacher_frames=other), 0.05, 3.0),
        (mixed, 0.05 * (1 + weight), 0.0),
    ):
        monkeypatch.setattr("tests.training.test_reconstructor.sample", lambda batch=batch: batch)
        terms = {"error": SquaredError(), "distillation": Distillation(distillation)}
        fitted.append(fit(Leaky(), lr=lr, loss=TrainingLoss(terms)))
    for ours, theirs in zip(*(net.parameters() for net in fitted), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-6)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (["optics=single"], "teachers must take optics.views=1, lf3x3 takes 9"),
        (["teachers=[nobody]"], "teachers must be networks: ckpt .*nobody"),
        (["loss.distillation.weight=-1"], "loss.distillation.weight must be >= 0, got -1"),
    ],
)
def test_wrong_values_are_one_line(asked, message, tmp_path):
    cfg = config("train", tmp_path, "experiment=setnet_small", "teachers=lf3x3", *asked)
    with pytest.raises(ValueError, match=message):
        build.build_data_module(cfg)
        build.build_reconstructor(cfg, *build.build_untrained_network(cfg))
