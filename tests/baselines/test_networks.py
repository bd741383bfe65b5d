"""What every frozen network must do, and what is particular to each."""

import jaxtyping
import numpy as np
import pytest
import torch
from torch.nn import functional

from baselines import etnet, hypere2vid
from baselines.cista import CISTA
from baselines.e2vid_plus import E2VIDPlus
from baselines.etnet import ETNet
from baselines.firenet import FireNet
from baselines.highpass import HighPass
from baselines.hypere2vid import DynamicDecoder, HyperE2VID, fourier_bessel_functions
from baselines.pienet import PIENet
from src.models.network import unroll
from src.sim.optics import Optics, layout

PUBLISHED = {
    FireNet: 37_777,
    E2VIDPlus: 10_710_401,
    ETNet: 22_175_361,
    HyperE2VID: 10_149_881,
    CISTA: 1_260_867,
    PIENet: 171_121,
}


def small(kind: type) -> torch.nn.Module:
    torch.manual_seed(0)
    width = "channels" if kind in (FireNet, CISTA) else "base_channels"
    return kind(bins=3, **{width: 4}).eval()


def voxels(n: int = 1, windows: int = 3, views: int = 9, side: int = 24) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(n, windows, views, 3, side, side, generator=generator)


@pytest.mark.parametrize("kind", PUBLISHED)
def test_published_parameter_counts(kind):
    assert sum(p.numel() for p in kind().parameters()) == PUBLISHED[kind]


def test_published_buffers_of_hypere2vid():
    assert sum(b.numel() for b in HyperE2VID().buffers()) == 574


@pytest.mark.parametrize("kind", PUBLISHED)
@torch.no_grad()
def test_any_size_comes_back_and_only_the_centre_view_counts(kind):
    network = small(kind)
    window = voxels(2)[:, 0, ..., :21, :19]
    frame, _ = network(window, None)
    alone, _ = network(window[:, 4:5], None)
    assert frame.shape == (2, 1, 21, 19)
    assert torch.equal(frame, alone)


@pytest.mark.parametrize(
    "optics", [Optics(2), Optics(4), Optics(5), Optics(9), Optics(2, [(0, 1), (0, 0)])], ids=str
)
@pytest.mark.parametrize("kind", [*PUBLISHED, HighPass])
@torch.no_grad()
def test_the_centre_view_is_that_of_the_optics(kind, optics):
    network = HighPass() if kind is HighPass else small(kind)
    seen = voxels(views=optics.views)
    frames, _ = unroll(network, seen, positions=optics.positions)
    alone, _ = unroll(network, seen[:, :, [optics.centre]])
    assert torch.equal(frames, alone)


@pytest.mark.parametrize("kind", PUBLISHED)
def test_other_bins_are_refused(kind):
    with pytest.raises(ValueError, match="bins must be 3"):
        small(kind)(torch.zeros(1, 1, 5, 24, 24), None)


def call_unchecked(network, *args, **options):
    """Call `network` without the type checks of tests."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        return network(*args, **options)
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize("kind", [*PUBLISHED, HighPass])
@torch.no_grad()
def test_positions_are_one_for_each_view_of_any_kind_of_array(kind):
    network = HighPass() if kind is HighPass else small(kind)
    seen = voxels()[:, 0]
    frame, _ = network(seen)
    for array in (torch.tensor(layout(9)), np.array(layout(9))):
        assert torch.equal(call_unchecked(network, seen, positions=array)[0], frame)
    with pytest.raises(
        ValueError, match=r"positions must be 9 \(row, col\), .*, got 1: \[\(0, 0\)\]"
    ):
        network(seen, positions=[(0, 0)])
    with pytest.raises(ValueError, match=r"positions must be 3 \(row, col\), .*, got 9: "):
        network(seen[:, :3], positions=layout(9))


@pytest.mark.parametrize("dtype", [torch.float64, torch.int16])
@pytest.mark.parametrize("kind", PUBLISHED)
@torch.no_grad()
def test_voxels_may_be_of_any_number_type(kind, dtype):
    network, seen = small(kind), (3 * voxels()[:, 0]).round()
    assert torch.equal(call_unchecked(network, seen.to(dtype))[0], network(seen)[0])


@pytest.mark.parametrize("kind", [*PUBLISHED, HighPass])
@torch.no_grad()
def test_a_state_of_another_size_and_grids_without_clips_are_refused(kind):
    network = HighPass() if kind is HighPass else small(kind)
    seen = voxels(2, side=42)[:, 0]  # sides that are padded, and pooled with a rest
    state = network(seen, network(seen)[1])[1]  # fits itself
    for other in (seen[..., :24], seen[:1]):
        with pytest.raises(ValueError, match=r"state must have sizes \[\(.* for these voxels, got"):
            network(other, state)
    with pytest.raises(ValueError, match=r"voxels must be \(clips, views, bins, height, width\)"):
        call_unchecked(network, seen[0])


def test_cista_is_exported_as_a_graph_of_pytorch():
    network, seen = small(CISTA), voxels()[:, 0]
    graph = torch.export.export(network, (seen,)).module()
    torch.testing.assert_close(graph(seen)[0], network(seen)[0])


@torch.no_grad()
def test_fused_attention_is_attention():
    layer, x, memory = (
        etnet.MultiHeadAttention(16).eval(),
        torch.randn(2, 7, 16),
        torch.randn(2, 7, 16),
    )
    plain = torch.nn.MultiheadAttention(16, etnet.HEADS, batch_first=True).eval()
    plain.in_proj_weight.copy_(layer.project.weight)
    plain.in_proj_bias.copy_(layer.project.bias)
    plain.out_proj.load_state_dict(layer.out.state_dict())
    torch.testing.assert_close(layer(x, memory), plain(x, memory, memory)[0])


def test_sinusoids_start_with_sine_zero_and_cosine_one():
    table = etnet.sinusoidal_position_encoding(5, 8)
    assert table.shape == (5, 8)
    assert table[0].tolist() == [0, 1] * 4
    torch.testing.assert_close(table[:, 0], torch.arange(5.0).sin())
    torch.testing.assert_close(table[:, 7], (torch.arange(5.0) / 10_000**0.75).cos())


@torch.no_grad()
def test_dynamic_convolution_is_one_with_a_kernel_for_each_pixel():
    decoder = DynamicDecoder(2, 3, 4).eval()
    x, context = torch.randn(1, 2, 3, 4), torch.randn(1, 4, 24, 32)
    small = functional.interpolate(context, scale_factor=0.25, mode="bilinear")
    weights = decoder.weigh(decoder.fuse(small)).unflatten(1, (hypere2vid.ATOMS, -1))
    kernels = torch.einsum("nmkhw,kl->nmlhw", weights, decoder.functions)
    grown = functional.interpolate(x, scale_factor=2, mode="bilinear")
    patches = functional.unfold(grown, 5, padding=2).view(1, 2, 25, 6, 8)
    atoms = torch.einsum("nmlhw,nclhw->ncmhw", kernels, patches).flatten(1, 2)
    torch.testing.assert_close(decoder(x, context), decoder.compose(atoms).relu())


def test_fourier_bessel_functions():
    small, large = fourier_bessel_functions(1), fourier_bessel_functions(2)
    assert small.shape == (6, 3, 3) and large.shape == (14, 5, 5)
    # The first is J0, positive, highest in the middle; the published values are these.
    assert float(small[0, 1, 1]) == pytest.approx(0.6731, abs=1e-4)
    assert float(large[0, 2, 2]) == pytest.approx(0.4387, abs=1e-4)
    assert float(large.square().sum((1, 2)).mean()) == pytest.approx(1)
    torch.testing.assert_close(large[1], large[2].T)  # cos and sin of one turn
    torch.testing.assert_close(large[1], -large[1].flip(0))


@torch.no_grad()
def test_cista_shrinks_its_code():
    network = small(CISTA)
    for step in network.steps:
        step.threshold.fill_(1e6)
    _, (code, _, _) = network(voxels()[:, 0], None)
    assert float(code.abs().max()) == 0


def test_pie_net_lite_and_the_layers_that_its_package_leaves_out_are_counted():
    lite = PIENet(base_channels=12, channels=(16, 24), pools=(2, 2))
    assert sum(p.numel() for p in lite.parameters()) == 78_537
    assert sum(p.numel() for p in PIENet(refine=False).parameters()) == 154_201


@torch.no_grad()
def test_pie_net_gates_its_skips_from_the_second_window_on():
    network, window = small(PIENet), voxels()[:, 0]
    first, state = network(window)
    for decoder in network.decoders:
        decoder.gate.bias.fill_(-9)  # nothing passes
    again, _ = network(window)
    gated, _ = network(window, state)
    opened, _ = network(window, state._replace(begun=torch.zeros(1, 1, 1, 1)))
    assert torch.equal(first, again) and not torch.equal(gated, opened)


@torch.no_grad()
def test_pie_net_takes_maps_that_are_smaller_than_what_it_pools():
    frame, _ = small(PIENet)(torch.randn(1, 1, 3, 9, 30))  # 2 x 7 before five are pooled
    assert frame.shape == (1, 1, 9, 30) and frame.isfinite().all()
