"""Dead channels are counted where no gradient reaches."""

import pytest
import torch
from torch import nn

from src.sim.pipeline import Sample
from src.training.idle import idle_share
from src.training.reconstructor import Reconstructor


class Shut(nn.Module):
    """Four channels behind a ReLU, of which three never open, and what they are drawn with."""

    def __init__(self):
        super().__init__()
        self.seen, self.relu, self.drawn = (
            nn.Conv2d(2, 4, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(4, 1, 1),
        )
        with torch.no_grad():
            self.seen.bias.copy_(torch.tensor([100.0, -100, -100, -100]))

    def forward(self, voxels, state=None):
        return self.drawn(self.relu(self.seen(voxels[:, 0]))), state


def test_only_what_runs_counts():
    dark = torch.zeros(1, 3, 1, 5, 5)
    clip = Sample(torch.ones(1, 3, 1, 2, 5, 5), dark, dark, torch.ones(1))
    network = Shut().train()
    assert idle_share(Reconstructor(network, {}), [clip]) == pytest.approx(3 / 5)
    assert network.training and all(part.grad is None for part in network.parameters())
    assert idle_share(Reconstructor(nn.Identity(), {}), []) == 0.0
