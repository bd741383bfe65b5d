"""The training step: loss averaged over windows, graph cut where asked, one optimiser step."""

import copy
from collections.abc import Sequence
from unittest.mock import patch

import lightning
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from src.models.unroll import chunks, detach, unroll
from src.sim.pipeline import Sample
from src.training import reconstructor, steadiness
from src.training.reconstructor import Reconstructor
from src.training.steadiness import unrest

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`")


class Leaky(nn.Module):
    """A recurrent network of two numbers: state <- a * state + b * sum of the voxels."""

    views = None

    def __init__(self):
        super().__init__()
        self.a, self.b = nn.Parameter(torch.tensor(0.5)), nn.Parameter(torch.tensor(0.3))

    def forward(self, voxels, state):
        events = voxels.sum((1, 2))[:, None]
        state = self.b * events if state is None else self.a * state + self.b * events
        return state, state


class SquaredError(nn.Module):
    def forward(self, prediction, target):
        return (prediction - target).square().mean((1, 2, 3))


def sample(windows: int = 6) -> Sample:
    generator = torch.Generator().manual_seed(0)
    voxels = torch.randn(2, windows, 1, 5, 8, 8, generator=generator)
    target = torch.rand(2, windows, 1, 8, 8, generator=generator)
    window_s = torch.full((2,), 1 / 120)
    return Sample(voxels, target, target, window_s, drawn=[{"name": "a"}, {"name": "b"}])


def fit(
    network: nn.Module,
    detach_every: int,
    steps: int = 1,
    lr: float = 0.05,
    callbacks: Sequence[lightning.Callback] = (),
    **how,
) -> nn.Module:
    def optimizer(parameters):
        return torch.optim.SGD(parameters, lr=lr)

    how = {"loss": SquaredError(), "optimizer": optimizer, "detach_every": detach_every} | how
    module = Reconstructor(network, {}, **how)
    trainer = lightning.Trainer(
        max_steps=steps,
        callbacks=list(callbacks),
        accelerator="cpu",
        logger=False,
        log_every_n_steps=1,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, DataLoader([sample()] * steps, collate_fn=lambda items: items[0]))
    return network


def by_hand(
    detach_every: int,
    loss_from: int = 0,
    clip: float = 1e9,
    steady: float = 0.0,
    pairs: Sequence[int] = (),
    calm: float = 0.0,
) -> nn.Module:
    network, batch = Leaky(), sample()
    state, losses, errors, frames = None, [], [], []
    for window in range(batch.voxels.shape[1]):
        if detach_every and window % detach_every == 0:
            state = detach(state)
        frame, state = network(batch.voxels[:, window], state)
        frames.append(frame)
        errors.append(frame - batch.target[:, window])
        losses.append(errors[-1].square().mean())
    firsts = pairs or range(loss_from, len(errors) - 1)
    changes = [(errors[first + 1] - errors[first]).abs().mean() for first in firsts]
    if pairs:
        losses = [losses[first + one] for first in pairs for one in (0, 1)]
    loss = torch.stack(losses[loss_from if not pairs else 0 :]).mean()
    follows = torch.ones(len(frames) - 1, dtype=torch.bool)
    loss = loss + calm * unrest(torch.stack(frames, 1), batch.target, follows)
    (loss + steady * torch.stack(changes).mean()).backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter -= 0.05 * parameter.grad
    return network


@pytest.mark.parametrize("detach_every", [0, 1, 4, 6])
def test_a_step_equals_the_step_written_out(detach_every, monkeypatch):
    monkeypatch.setattr(
        reconstructor, "PICTURES", {"cpu": 5}
    )  # pieces of the loss cut through clips
    ours, theirs = fit(Leaky(), detach_every), by_hand(detach_every)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)


@pytest.mark.parametrize("detach_every", [0, 2, 4])
def test_the_loss_begins_where_it_is_told_and_gradients_are_clipped(detach_every):
    ours, theirs = fit(Leaky(), detach_every, loss_from=3, clip=0.1), by_hand(detach_every, 3, 0.1)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)
    assert not torch.allclose(theirs.a, by_hand(detach_every, 0, 0.1).a, atol=1e-6)


@pytest.mark.parametrize("loss_from", [0, 2])
def test_what_flickers_costs(loss_from):
    how = {"loss_from": loss_from, "steady": 3.0}
    ours, theirs = fit(Leaky(), 0, **how), by_hand(0, **how)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)
    assert not torch.allclose(theirs.a, by_hand(0, loss_from).a, atol=1e-3)


def test_what_changes_where_the_truth_stands_still_costs(monkeypatch):
    monkeypatch.setattr(steadiness, "STILL", 2.0)  # all of it does
    ours, theirs = fit(Leaky(), 0, calm=3.0), by_hand(0, calm=3.0)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)
    assert not torch.allclose(theirs.a, by_hand(0).a, atol=1e-3)


@pytest.mark.parametrize("detach_every", [0, 2])
def test_the_loss_sees_what_is_chosen(detach_every, monkeypatch):
    monkeypatch.setattr(Reconstructor, "_chosen", lambda *_: [1, 2, 4, 5])
    how = {"loss_from": 1, "steady": 0.0 if detach_every else 3.0}
    ours = fit(Leaky(), detach_every, **how, loss_pairs=2)
    theirs = by_hand(detach_every, **how, pairs=[1, 4])
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)


def test_pairs_stay_in_their_parts_and_are_drawn_anew_every_step():
    module, seen = Reconstructor(Leaky(), {}, loss_from=3, loss_pairs=4), set()
    for step in range(200):
        with patch.object(Reconstructor, "global_step", step):
            chosen = module._chosen(40)
        seen |= set(chosen)
        for part, (first, second) in enumerate(zip(chosen[::2], chosen[1::2], strict=True)):
            assert second == first + 1
            assert 3 + part * 37 // 4 <= first and second < 3 + (part + 1) * 37 // 4
    assert seen == set(range(3, 40))


def test_cutting_the_graph_changes_the_gradient():
    assert not torch.allclose(by_hand(0).a, by_hand(1).a, atol=1e-6)


def test_negative_detach_length_is_refused():
    with pytest.raises(ValueError, match="data.detach_every"):
        Reconstructor(Leaky(), {}, detach_every=-1)


def test_chunks_cover_every_window_once():
    assert list(chunks(5, 2)) == [slice(0, 2), slice(2, 4), slice(4, 5)]
    assert list(chunks(5, 0)) == [slice(0, 5)]


def test_two_chunks_with_the_state_carried_over_equal_one():
    network, voxels = Leaky(), sample().voxels
    whole, _ = unroll(network, voxels)
    first, state = unroll(network, voxels[:, :2])
    second, _ = unroll(network, voxels[:, 2:], state)
    assert torch.equal(whole, torch.cat([first, second], dim=1))


def test_detach_reaches_nested_states():
    leaf = torch.ones(1, requires_grad=True) * 2
    state = detach({"h": (leaf, [leaf]), "n": None})
    assert not state["h"][0].requires_grad and not state["h"][1][0].requires_grad
    assert leaf.requires_grad and state["n"] is None


def test_a_loss_that_is_not_finite_stops_training():
    network = Leaky()
    with torch.no_grad():
        network.b.fill_(float("nan"))
    before = copy.deepcopy(network.state_dict())
    with pytest.raises(ValueError, match="loss"):
        fit(network, 0)
    assert torch.equal(before["a"], network.a)
