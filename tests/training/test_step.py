"""Where a step's time goes, what arithmetic it does, and a sequence as one graph of launches."""

import pytest
import torch
from torch import nn

from src.models.setnet import SetNet
from src.models.setnet_layers import PacedUpdate, paced_update
from src.models.unroll import unroll
from src.training import graphed
from src.training.graphed import GraphedUnroll, Unrolled
from src.training.step_time import Arithmetic, SpeedSplit, StageClock, matrix_peak
from tests.training.test_reconstructor import Leaky, fit

pytestmark = pytest.mark.filterwarnings("ignore:You defined a `validation_step`")


def test_arithmetic_is_that_of_the_convolutions_forward_and_backward():
    layer, x = nn.Conv2d(3, 4, 5, padding=2), torch.rand(2, 3, 8, 8, requires_grad=True)
    one = 2 * 2 * 8 * 8 * 4 * 3 * 25
    with Arithmetic() as counted:
        layer(x).sum().backward()
    assert counted.flops == 3 * one  # the gradient of the input and that of the kernel
    with Arithmetic() as counted:
        torch.rand(4, 5) @ torch.rand(5, 6)
    assert counted.flops == 2 * 4 * 5 * 6


def test_counting_changes_no_number():
    def gradient(counts: bool) -> torch.Tensor:
        torch.manual_seed(0)
        net = SetNet(half=8, around=(8, 8, 8))
        voxels = torch.randn(1, 4, 9, 5, 16, 16, generator=torch.Generator().manual_seed(1))
        with Arithmetic() if counts else torch.enable_grad():
            unroll(net, voxels)[0].square().sum().backward()
        return torch.cat([p.grad.flatten() for p in net.parameters() if p.grad is not None])

    assert torch.equal(gradient(True), gradient(False))


def test_stages_add_up_and_off_cost_nothing():
    clock = StageClock()
    clock.start()
    clock.mark("loss")
    assert clock.seconds == {}
    clock.on = True
    clock.start()
    for stage in ("forward", "loss", "forward"):
        clock.mark(stage)
    assert set(clock.seconds) == {"forward", "loss"} and min(clock.seconds.values()) >= 0


def test_the_report_of_a_training(capsys):
    split = SpeedSplit(after=4)
    fit(Leaky(), 0, steps=6, callbacks=[split])
    report = split.report
    assert 0 < sum(report["shares"].values()) <= 1.001  # what is between stages is nobody's
    assert set(report["shares"]) == {"simulation", "forward", "loss", "backward", "optimiser"}
    assert report["samples_per_s"] > 0 and report["peak_tflops"] > 0
    printed = capsys.readouterr().out
    assert printed.count("per step: simulation") == 2 and "model FLOP utilisation" in printed


def test_a_training_that_fails_counts_no_further():
    class Failing(Leaky):
        def forward(self, voxels, state):
            raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        fit(Failing(), 0, callbacks=[SpeedSplit()])
    assert torch.utils._python_dispatch._get_current_dispatch_mode() is None


def test_the_peak_is_that_of_a_product_of_matrices():
    assert 1e8 < matrix_peak(torch.device("cpu"), "32-true", trials=2) < 1e15


@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16])
def test_a_paced_update_has_autograd_s_gradients(kind):
    drawer = torch.Generator().manual_seed(0)
    both = torch.randn(2, 6, 5, 4, generator=drawer).to(kind)
    both = both.contiguous(memory_format=torch.channels_last)
    state = torch.rand(2, 3, 5, 4, generator=drawer)
    pace = torch.tensor([0.7, 0.0]).reshape(2, 1, 1, 1)
    slope = torch.randn(2, 3, 5, 4, generator=drawer)

    def gradients(update) -> tuple[torch.Tensor, ...]:
        leaves = both.clone().requires_grad_(), state.clone().requires_grad_()
        after = update(*leaves, pace)
        return after, *torch.autograd.grad(after, leaves, slope)

    ours, theirs = gradients(PacedUpdate.apply), gradients(paced_update)
    assert torch.equal(ours[0], theirs[0])
    for mine, other in zip(ours[1:], theirs[1:], strict=True):
        assert mine.dtype == other.dtype
        torch.testing.assert_close(
            mine, other, rtol=2e-2 if kind == torch.bfloat16 else 1e-5, atol=1e-6
        )
    assert ours[1].is_contiguous(memory_format=torch.channels_last)


def unrolled(network: nn.Module, monkeypatch, **how) -> tuple[GraphedUnroll, list[str]]:
    """A GraphedUnroll on a CPU, whose graphs are made by `capture`, and what it says."""
    said: list[str] = []
    ours = GraphedUnroll(network, say=said.append, most=how.get("most", 24))
    monkeypatch.setattr(ours, "_captured", how["capture"])
    return ours, said


def batch(n: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    voxels = torch.randn(n, 3, 1, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    return voxels, torch.full((n,), 1 / 120)


def test_a_graph_is_made_the_second_time_and_then_used(monkeypatch):
    made = []

    def capture(plain: Unrolled, *example):
        made.append(plain.shown)
        return lambda voxels, window_s: plain(voxels, window_s) + 1

    network = Leaky()
    ours, _ = unrolled(network, monkeypatch, capture=capture)
    plain = unroll(network, batch()[0], shown=[1, 2])[0]
    frames = [ours(*batch(), None, [1, 2]) for _ in range(3)]
    assert torch.equal(frames[0], plain) and made == [[1, 2]]
    assert all(torch.equal(frame, plain + 1) for frame in frames[1:])
    assert torch.equal(ours(*batch(), None, [0, 1]), unroll(network, batch()[0], shown=[0, 1])[0])
    ours(*batch(3), None, [1, 2])
    assert len(ours.graphs) == 1  # another size and other windows have been seen once


def test_where_no_graph_can_be_made_the_training_goes_on_and_says_so(monkeypatch):
    def capture(*_):
        raise RuntimeError("CUDA error:\n operation not permitted")

    network = Leaky()
    ours, said = unrolled(network, monkeypatch, capture=capture)
    plain = unroll(network, batch()[0], shown=[2])[0]
    assert all(torch.equal(ours(*batch(), None, [2]), plain) for _ in range(4))
    assert said == [
        "step: no CUDA graphs, operators one by one: CUDA error: operation not permitted"
    ]


def test_there_are_no_more_graphs_than_asked_for(monkeypatch):
    ours, _ = unrolled(Leaky(), monkeypatch, capture=lambda plain, *_: plain, most=1)
    for shown in ([0], [1], [0], [1]):
        ours(*batch(), None, shown)
    assert len(ours.graphs) == 1


@pytest.mark.gpu
@pytest.mark.parametrize("half", [True, False])
def test_a_graph_gives_the_frames_and_gradients_of_its_operators(half):
    torch.manual_seed(0)
    network = SetNet.preset("small").cuda()
    voxels = (torch.rand(2, 12, 9, 5, 64, 64, device="cuda") < 0.1).float()
    window_s = torch.full((2,), 1 / 120, device="cuda")

    def gradients(forward) -> list[torch.Tensor]:
        network.zero_grad()
        with torch.autocast("cuda", torch.bfloat16, enabled=half):
            forward(voxels, window_s, None, [3, 4, 9]).square().sum().backward()
        return [p.grad.clone() for p in network.parameters() if p.grad is not None]

    said: list[str] = []
    ours = GraphedUnroll(network, say=said.append)
    first, second, third = (gradients(ours) for _ in range(3))
    assert not said and len(ours.graphs) == 1
    for plain, made, again in zip(first, second, third, strict=True):
        torch.testing.assert_close(made, again)
        torch.testing.assert_close(made, plain, rtol=0.05, atol=float(plain.abs().max()) * 0.05)
    assert graphed.TOLERANCE < 0.1
