"""The training step: loss averaged over windows, graph cut where asked, one optimiser step."""

import copy
from collections.abc import Sequence

import lightning
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from src.losses import terms
from src.losses.terms import FrameTerm, StaticFlicker, TemporalConsistency, TrainingLoss
from src.models.network import EventToVideoNetwork, unroll
from src.sim.pipeline import Sample
from src.training import reconstructor
from src.training.reconstructor import Reconstructor, select_loss_windows
from src.training.step_guard import StepGuard

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`")


class Leaky(EventToVideoNetwork):
    """A recurrent network of two numbers: state <- a * state + b * sum of the voxels."""

    views = None

    def __init__(self):
        super().__init__()
        self.a, self.b = nn.Parameter(torch.tensor(0.5)), nn.Parameter(torch.tensor(0.3))

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        events = voxels.sum((1, 2))[:, None]
        state = self.b * events if state is None else self.a * state + self.b * events
        return state, state


class SquaredError(FrameTerm):
    def forward(self, prediction, target):
        return (prediction - target).square().mean((1, 2, 3))


def sample(windows: int = 6) -> Sample:
    generator = torch.Generator().manual_seed(0)
    voxels = torch.randn(2, windows, 1, 5, 8, 8, generator=generator)
    target = torch.rand(2, windows, 1, 8, 8, generator=generator)
    window_s = torch.full((2,), 1 / 120)
    return Sample(voxels, target, target, window_s, parameters=[{"name": "a"}, {"name": "b"}])


def fit(
    network: nn.Module,
    steps: int = 1,
    lr: float = 0.05,
    loss: TrainingLoss | None = None,
    **how,
) -> nn.Module:
    def optimizer(parameters):
        return torch.optim.SGD(parameters, lr=lr)

    loss = loss or TrainingLoss({"error": SquaredError()})
    how = {"loss": loss, "optimizer": optimizer} | how
    module = Reconstructor(network, {}, **how)
    trainer = lightning.Trainer(
        max_steps=steps,
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
    loss_from: int = 0,
    clip: float = 1e9,
    consistency: float = 0.0,
    pairs: Sequence[int] = (),
    flicker: float = 0.0,
) -> nn.Module:
    network, batch = Leaky(), sample()
    state, losses, errors, frames = None, [], [], []
    for window in range(batch.voxels.shape[1]):
        frame, state = network(batch.voxels[:, window], state)
        frames.append(frame)
        errors.append(frame - batch.target[:, window])
        losses.append(errors[-1].square().mean())
    firsts = pairs or range(loss_from, len(errors) - 1)
    changes = [(errors[first + 1] - errors[first]).abs().mean() for first in firsts]
    if pairs:
        losses = [losses[first + one] for first in pairs for one in (0, 1)]
    loss = torch.stack(losses[loss_from if not pairs else 0 :]).mean()
    consecutive = torch.ones(len(frames) - 1, dtype=torch.bool)
    loss = loss + flicker * StaticFlicker()(torch.stack(frames, 1), batch.target, consecutive)
    (loss + consistency * torch.stack(changes).mean()).backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), clip)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter -= 0.05 * parameter.grad
    return network


def test_a_step_equals_the_step_written_out(monkeypatch):
    monkeypatch.setattr(terms, "FRAMES_AT_A_TIME", {"cpu": 5})  # pieces cut through clips
    ours, theirs = fit(Leaky()), by_hand()
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)


def test_the_loss_begins_where_it_is_told_and_gradients_are_clipped():
    ours = fit(Leaky(), loss_from=3, guard=StepGuard(grad_clip_norm=0.1))
    theirs = by_hand(3, 0.1)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)
    assert not torch.allclose(theirs.a, by_hand(0, 0.1).a, atol=1e-6)


class Wrong(Leaky):
    """Frames without an axis of channels."""

    def sequence(self, voxels, state=None, **options):
        return voxels.sum((2, 3)), None


class Constant(Leaky):
    def forward(self, voxels, state=None, **options):
        frame, state = super().forward(voxels, state)
        return frame.detach(), state


def test_frames_of_another_shape_or_without_a_gradient_are_refused():
    message = r"Wrong must return frames \(clips, 1, h, w\) = \(2, 1, 8, 8\), got \(2, 8, 8\)"
    with pytest.raises(ValueError, match=message):
        unroll(Wrong(), sample().voxels)
    with pytest.raises(ValueError, match="Constant must return frames with a gradient"):
        fit(Constant())


def with_term(term) -> TrainingLoss:
    return TrainingLoss({"error": SquaredError(), "term": term})


@pytest.mark.parametrize("loss_from", [0, 2])
def test_temporal_consistency_is_added(loss_from):
    ours = fit(Leaky(), loss_from=loss_from, loss=with_term(TemporalConsistency(3.0)))
    theirs = by_hand(loss_from, consistency=3.0)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)
    assert not torch.allclose(theirs.a, by_hand(loss_from).a, atol=1e-3)


def test_static_flicker_is_added(monkeypatch):
    monkeypatch.setattr(terms, "STATIC_CHANGE", 2.0)  # all of it is static
    ours = fit(Leaky(), loss=with_term(StaticFlicker(3.0)))
    theirs = by_hand(flicker=3.0)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)
    assert not torch.allclose(theirs.a, by_hand().a, atol=1e-3)


def test_the_loss_sees_the_selected_windows(monkeypatch):
    monkeypatch.setattr(reconstructor, "select_loss_windows", lambda *_: [1, 2, 4, 5])
    ours = fit(Leaky(), loss_from=1, loss_pairs=2, loss=with_term(TemporalConsistency(3.0)))
    theirs = by_hand(1, consistency=3.0, pairs=[1, 4])
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)


def test_the_windows_that_the_loss_sees_follow_from_the_seed(monkeypatch):
    drawn = []
    monkeypatch.setattr(
        reconstructor, "select_loss_windows", lambda *given: drawn.append(given[-1]) or [1, 2]
    )
    for seed in (0, 0, 1):
        fit(Leaky(), loss_from=1, loss_pairs=1, steps=2, seed=seed)
    assert drawn[:2] == drawn[2:4] and len({*drawn}) == 4


def test_pairs_stay_in_their_parts_and_are_drawn_anew_every_step():
    seen = set()
    for step in range(200):
        selected = select_loss_windows(40, 3, 4, step)
        seen |= set(selected)
        for part, (first, second) in enumerate(zip(selected[::2], selected[1::2], strict=True)):
            assert second == first + 1
            assert 3 + part * 37 // 4 <= first and second < 3 + (part + 1) * 37 // 4
    assert seen == set(range(3, 40))


def test_two_chunks_with_the_state_carried_over_equal_one():
    network, voxels = Leaky(), sample().voxels
    whole, _ = unroll(network, voxels)
    first, state = unroll(network, voxels[:, :2])
    second, _ = unroll(network, voxels[:, 2:], state)
    assert torch.equal(whole, torch.cat([first, second], dim=1))


def test_a_loss_that_is_not_finite_stops_training():
    network = Leaky()
    with torch.no_grad():
        network.b.fill_(float("nan"))
    before = copy.deepcopy(network.state_dict())
    with pytest.raises(ValueError, match="loss"):
        fit(network)
    assert torch.equal(before["a"], network.a)
