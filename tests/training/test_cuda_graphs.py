"""A training sequence as one CUDA graph."""

from itertools import combinations
from weakref import ref

import pytest
import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode

from src.models import setnet
from src.models.network import unroll
from src.models.setnet import SetNet
from src.sim.optics import layout
from src.training import cuda_graphs
from src.training.cuda_graphs import GraphedUnroll, UnrolledNetwork
from tests.training.test_reconstructor import Leaky


def unrolled(network: nn.Module, monkeypatch, capture) -> GraphedUnroll:
    """A GraphedUnroll on a CPU, whose graphs are made by `capture`."""
    ours = GraphedUnroll(network)
    monkeypatch.setattr(ours, "_capture", capture)
    return ours


def batch(n: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    voxels = torch.randn(n, 3, 1, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    return voxels, torch.full((n,), 1 / 120)


def test_a_graph_is_made_the_second_time_and_then_used(monkeypatch):
    made = []

    def capture(plain: UnrolledNetwork, *example):
        made.append(plain.output_windows)
        return lambda voxels, window_s: plain(voxels, window_s) + 1

    network = Leaky()
    ours = unrolled(network, monkeypatch, capture)
    plain = unroll(network, batch()[0], output_windows=[1, 2])[0]
    frames = [ours(*batch(), None, [1, 2]) for _ in range(3)]
    assert torch.equal(frames[0], plain) and made == [[1, 2]]
    assert all(torch.equal(frame, plain + 1) for frame in frames[1:])
    assert torch.equal(
        ours(*batch(), None, [0, 1]), unroll(network, batch()[0], output_windows=[0, 1])[0]
    )
    ours(*batch(3), None, [1, 2])
    assert len(ours.graphs) == 1  # another size and other windows have been seen once


def test_where_no_graph_can_be_made_the_training_goes_on_and_says_so(monkeypatch, capsys):
    def capture(*_):
        raise RuntimeError("CUDA error:\n operation not permitted")

    network = Leaky()
    ours = unrolled(network, monkeypatch, capture)
    plain = unroll(network, batch()[0], output_windows=[2])[0]
    assert all(torch.equal(ours(*batch(), None, [2]), plain) for _ in range(4))
    why = "CUDA error: operation not permitted"
    line = f"cuda_graphs: none, other batches operator by operator: {why}\n"
    assert capsys.readouterr().out == line


def test_graphs_that_were_made_stay_where_the_memory_holds_no_other(monkeypatch, capsys):
    def capture(plain: UnrolledNetwork, *_):
        if plain.output_windows == [1]:
            raise torch.OutOfMemoryError("CUDA out of memory.\n Tried to allocate")
        return plain

    ours = unrolled(Leaky(), monkeypatch, capture)
    for shown in ([0], [0], [1], [1], [2], [2]):
        ours(*batch(), None, shown)
    assert [name[-1] for name in ours.graphs] == [(0,)]
    assert capsys.readouterr().out.startswith("cuda_graphs: 1, other batches operator by operator:")


def test_there_are_no_more_graphs_than_asked_for(monkeypatch):
    monkeypatch.setattr(cuda_graphs, "MAX_GRAPHS", 1)
    ours = unrolled(Leaky(), monkeypatch, lambda plain, *_: plain)
    for shown in ([0], [1], [0], [1]):
        ours(*batch(), None, shown)
    assert len(ours.graphs) == 1


def test_no_shape_and_no_branch_of_a_setnet_depends_on_events(monkeypatch):
    """Else no graph can be made: what is traced has no values."""
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)  # as on a GPU
    setnet._keep_on_device.cache_clear()  # of tensors with values
    with FakeTensorMode():
        network = SetNet.preset("medium")
        voxels, window_s = torch.zeros(2, 6, 9, 5, 64, 64), torch.full((2,), 1 / 120)
        frames, _ = unroll(network, voxels, window_s=window_s, output_windows=[1, 4])
        frames.sum().backward()
        assert frames.shape == (2, 2, 1, 64, 64)
    setnet._keep_on_device.cache_clear()  # of tensors without values


def test_what_a_graph_of_a_setnet_reads_is_never_freed(monkeypatch):
    """Tensors made outside a graph's memory, which replays read and do not ask for again."""
    network, voxels = SetNet.preset("small"), torch.zeros(1, 3, 4, 5, 8, 8)
    make, made = torch.tensor, list[ref]()

    def tensor(*args, **options):
        made.append(ref(new := make(*args, **options)))
        return new

    setnet._keep_on_device.cache_clear()
    monkeypatch.setattr(torch, "tensor", tensor)
    with torch.no_grad():
        unroll(network, voxels, positions=layout(4), output_windows=[0, 2])
        count = len(made)
        for where in combinations(layout(25), 2):
            network.stem_kernels_and_bias(where)
    assert count and all(one() is not None for one in made[:count])


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

    ours = GraphedUnroll(network)
    first, second, third = (gradients(ours) for _ in range(3))
    assert len(ours.graphs) == 1
    for plain, made, again in zip(first, second, third, strict=True):
        torch.testing.assert_close(made, again)
        torch.testing.assert_close(made, plain, rtol=0.05, atol=float(plain.abs().max()) * 0.05)
    assert cuda_graphs.TOLERANCE < 0.1
