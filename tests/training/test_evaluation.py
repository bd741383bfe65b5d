"""A network on the test clips: the frames that are kept, and what a signal does."""

import os
import signal
from dataclasses import replace

import lightning
import pytest
import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch.utils.data import DataLoader

from baselines.firenet import FireNet
from baselines.postprocess import Postprocessed
from src.deploy.cost import Timing
from src.metrics.video_metrics import VideoMetrics
from src.models.backward_warmup import BackwardWarmup
from src.models.network import EventToVideoNetwork, FramePostprocessor
from src.sim.pipeline import Sample
from src.training import evaluation
from src.training.datamodule import LightFieldData


class SumOfEvents(EventToVideoNetwork):
    """A network that counts its windows."""

    views, windows = None, 0

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        self.windows += 1
        return voxels.sum((1, 2))[:, None].sigmoid(), state


class Terminated(SumOfEvents):
    """A network whose process is asked to end at its third window."""

    def forward(self, *args, **options):
        if self.windows == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().forward(*args, **options)


class Clips(LightFieldData):
    """Clips of three windows, not simulated."""

    def __init__(self, count: int = 1):
        lightning.LightningDataModule.__init__(self)
        self.samples = [self.draw(f"clip {n}") for n in range(count)]

    @staticmethod
    def draw(name: str) -> Sample:
        voxels, target = torch.randn(1, 3, 1, 5, 16, 16), torch.rand(1, 3, 1, 16, 16)
        window_s = torch.full((1,), 1 / 120)
        return Sample(voxels, target, target, window_s, parameters=[{"name": name}])

    def setup(self, stage):
        pass

    teardown = setup

    def test_dataloader(self):
        return DataLoader(self.samples, batch_size=None)

    def on_after_batch_transfer(self, batch, dataloader_idx):
        return batch


@pytest.fixture
def trainer() -> lightning.Trainer:
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    return lightning.Trainer(accelerator="cpu", enable_checkpointing=False, **quiet)


def test_the_first_clips_are_kept_with_the_frames_that_were_scored(trainer):
    network, data = SumOfEvents(), Clips(3)
    row, kept = evaluation.test_network(
        "any", network, data, VideoMetrics(), trainer=trainer, kept_clips=2
    )
    assert len(row.clips) == 3 and len(kept) == 2
    for (sample, frames), expected in zip(kept, data.samples, strict=False):
        assert sample.parameters == expected.parameters
        assert torch.equal(frames, network.reconstruct_clip(expected))


def test_no_clip_is_reconstructed_twice_for_its_pictures(trainer, monkeypatch):
    network = SumOfEvents()
    monkeypatch.setattr(evaluation, "measure_macs_and_ms", lambda *_: (0, 0.0))
    evaluation.test_network("any", network, Clips(2), VideoMetrics(), trainer=trainer, kept_clips=2)
    assert network.windows == 2 * 3


def test_sigterm_during_the_last_clip_is_not_forgotten(trainer):
    with pytest.raises(SIGTERMException):
        evaluation.test_network("any", Terminated(), Clips(), VideoMetrics(), trainer=trainer)


class Blurred(FramePostprocessor):
    """Stands for a post-processor with weights."""

    def __init__(self):
        super().__init__()
        self.blur = torch.nn.Conv2d(1, 1, 3, padding=1)

    def forward(self, frames):
        return self.blur(frames.flatten(0, 1)).unflatten(0, frames.shape[:2]), None


@pytest.mark.parametrize(
    "wrap",
    [
        lambda network: network,
        lambda network: BackwardWarmup(network, 0.02),
        lambda network: Postprocessed(network, Blurred()),
    ],
)
def test_cost_is_measured_on_the_device_of_the_clips(wrap):
    method, clip = wrap(FireNet()), Clips.draw("clip")  # on a CPU, as Lightning leaves a method
    seen, there = list[torch.device](), replace(clip.to("meta"), window_s=clip.window_s)
    for layer in (part for part in method.modules() if isinstance(part, torch.nn.Conv2d)):
        layer.register_forward_pre_hook(lambda self, given: seen.append(self.weight.device))
    macs, milliseconds = evaluation.measure_macs_and_ms(method, there)
    assert macs > 0 and milliseconds > 0 and set(seen) == {torch.device("meta")}


def test_time_is_the_least_of_several_windows(monkeypatch):
    busy = Timing(median_ms=527.0, least_ms=7.6, frames=5, clock="wall")
    monkeypatch.setattr(evaluation, "time_frame", lambda *_, **__: busy)
    window = torch.zeros(1, 1, 5, 16, 16)
    assert evaluation.measure_frame_macs_and_ms(FireNet(), window)[1] == 7.6
