"""A network on the test clips: what a signal that comes there does."""

import os
import signal

import lightning
import pytest
import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch.utils.data import DataLoader

from src.metrics.video_metrics import VideoMetrics
from src.models.network import EventToVideoNetwork
from src.sim.pipeline import Sample
from src.training import evaluation
from src.training.datamodule import LightFieldData


class Terminated(EventToVideoNetwork):
    """A network whose process is asked to end at its third window."""

    views, windows = None, 0

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        self.windows += 1
        if self.windows == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return voxels.sum((1, 2))[:, None].sigmoid(), state


class OneClip(LightFieldData):
    """One clip without events, not simulated."""

    def __init__(self):
        lightning.LightningDataModule.__init__(self)

    def setup(self, stage):
        pass

    teardown = setup

    def test_dataloader(self):
        voxels, target = torch.zeros(1, 3, 1, 5, 16, 16), torch.rand(1, 3, 1, 16, 16)
        sample = Sample(
            voxels, target, target, torch.full((1,), 1 / 120), parameters=[{"name": "a"}]
        )
        return DataLoader([sample], batch_size=None)

    def on_after_batch_transfer(self, batch, dataloader_idx):
        return batch


def test_sigterm_during_the_last_clip_is_not_forgotten():
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = lightning.Trainer(accelerator="cpu", enable_checkpointing=False, **quiet)
    with pytest.raises(SIGTERMException):
        evaluation.test_network("any", Terminated(), OneClip(), VideoMetrics(), trainer=trainer)
