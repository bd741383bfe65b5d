"""Which views and which network are taken, on voxel grids whose agreement is known."""

import pytest
import torch

from src.models.adaptive import Adaptive, Level
from src.models.setnet import SetNet


def small(seed: int = 0, half: int = 4) -> SetNet:
    torch.manual_seed(seed)
    return SetNet(half=half).eval()


def grids(agree: bool, seed: int) -> torch.Tensor:
    torch.manual_seed(seed)
    one = torch.randn(1, 1, 5, 32, 32)
    return one.expand(1, 9, 5, 32, 32) if agree else torch.randn(1, 9, 5, 32, 32)


def levels_used(adaptive: Adaptive, agreement: list[bool]) -> list[int]:
    state, used = None, []
    for k, agree in enumerate(agreement):
        _, state = adaptive(grids(agree, k), state)
        used.append(state.level)
    return used


def test_views_that_agree_are_looked_at_once_and_give_what_the_network_gives():
    network = small()
    adaptive = Adaptive([Level(network, 1), Level(network, 9)], tolerance=0.5)
    shown = grids(True, 0)
    frame, state = adaptive(shown)
    assert state.level == 0 and state.disagreement == pytest.approx(0, abs=1e-6)
    with torch.no_grad():
        assert torch.equal(frame, network(shown[:, 4:5], None, positions=[(0, 0)])[0])


def test_it_goes_up_at_once_and_down_only_after_patience():
    network = small()
    adaptive = Adaptive([Level(network, 1), Level(network, 9)], tolerance=0.5, patience=4)
    used = levels_used(adaptive, [True] * 8 + [False] * 2 + [True] * 60)
    assert used[:8] == [0] * 8 and used[9] == 1
    up = len(used) - used[::-1].index(1)
    assert 8 + 4 < up < 65 and used[up:] == [0] * (len(used) - up)


def test_a_larger_network_runs_along_before_it_is_shown():
    levels = [Level(small(0), 1), Level(small(1, 6), 9)]
    adaptive = Adaptive(levels, tolerance=0.5, handover=3)
    used = levels_used(adaptive, [True] * 8 + [False] * 8)
    first = used.index(1)
    assert used[:first] == [0] * first and used[first:] == [1] * (len(used) - first)
    assert first >= 8 + 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"tolerance": 0}, "adapt.tolerance"), ({"tolerance": 1, "patience": 0}, "adapt.patience")],
)
def test_what_cannot_be_is_named(changes, message):
    network = small()
    with pytest.raises(ValueError, match=message):
        Adaptive([Level(network, 1), Level(network, 9)], **changes)
    with pytest.raises(ValueError, match=r"adapt\.levels"):
        Adaptive([Level(network, 1)], tolerance=1.0)
