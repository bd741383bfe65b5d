"""Triton's warp and scatter without a GPU: run by Triton's interpreter, and compiled for GPUs.

Each in a process of its own, because Triton reads TRITON_INTERPRET when it is imported.
"""

import sys
from importlib.util import find_spec
from itertools import product

import pytest
import torch

from src.sim.turbulence.coefficient_grid import GridAxis
from src.sim.turbulence.engines import blur_torch, device
from tests.sim.sensor.test_sensor_triton import in_a_process

triton = pytest.mark.skipif(not find_spec("triton"), reason="triton is not installed")
CUDA = torch.device("cuda", 0)


def agree() -> None:
    """Compare the kernels with plain torch; the last program of each has too many pixels."""
    from src.sim.turbulence.engines import blur_triton

    blur_triton.BLOCK = 32
    for size, pitch in product((1, 3, 6), (1, 3)):
        rows = GridAxis(-3, 13, pitch, 1)
        frames, tilt = torch.rand(2, 6, 11), 3 * torch.randn(2, 3, 13, 12)
        psfs = torch.rand(size**2, 3, rows.node_count, 12) - 0.3
        halo = torch.rand(2, 14 - size, 13 - size)
        one, other = (e.warp_cubic(frames, tilt, -3, 2, 1) for e in (blur_triton, blur_torch))
        torch.testing.assert_close(one, other, atol=2e-6, rtol=0)
        given = (psfs, rows, halo, 0.1, 1)
        one, other = (e.scatter_normalised(other, *given) for e in (blur_triton, blur_torch))
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def compiles() -> None:
    """Compile for compute capability 8.0 and 9.0; registers must not spill to memory."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from src.sim.turbulence.engines import blur_triton

    warp = (blur_triton._warp, "light tilt lows highs out", {"BLOCK": blur_triton.BLOCK})
    fixed = ({"BETWEEN": between, "BLOCK": blur_triton.BLOCK} for between in (False, True))
    scatters = [(blur_triton._scatter, "image psfs halo out", each) for each in fixed]
    for (kernel, tensors, fixed), capability in product((warp, *scatters), (80, 90)):
        names = kernel.arg_names
        types = dict.fromkeys(names, "i32") | dict.fromkeys(tensors.split(), "*fp32")
        types |= {"share": "fp32"} if "share" in names else {}
        types |= dict.fromkeys(fixed, "constexpr")
        source = ASTSource(kernel, types, {(names.index(name),): fixed[name] for name in fixed})
        ptx = triton.compile(source, target=GPUTarget("cuda", capability, 32)).asm["ptx"]
        assert "fma.rn.f32" in ptx and ".local" not in ptx


@triton
def test_the_kernels_are_plain_torch():
    in_a_process(agree, TRITON_INTERPRET="1")


@triton
def test_the_kernels_compile_for_gpus():
    in_a_process(compiles)


def test_a_gpu_without_triton_gets_plain_torch(monkeypatch):
    monkeypatch.setattr(device, "find_spec", lambda name: None)
    assert device.select_blur_engine.__wrapped__(CUDA) is blur_torch
    assert device.select_blur_engine(torch.device("cpu")) is blur_torch


@pytest.mark.parametrize("apart", [0.5, float("nan")])
def test_kernels_that_fail_or_differ_are_not_used_and_that_is_said(apart, monkeypatch):
    monkeypatch.setattr(device, "find_spec", lambda name: True)
    with pytest.warns(UserWarning, match="turbulence without Triton's kernels, slower: .*Error: "):
        assert device.select_blur_engine.__wrapped__(CUDA) is blur_torch  # there is no such device
    monkeypatch.setitem(sys.modules, "src.sim.turbulence.engines.blur_triton", blur_torch)
    monkeypatch.setattr(device, "max_difference_from_torch", lambda *_: apart)
    with pytest.warns(UserWarning, match="slower: they differ by"):
        assert device.select_blur_engine.__wrapped__(CUDA) is blur_torch


def test_an_engine_does_not_differ_from_itself():
    cpu = torch.device("cpu")
    assert device.max_difference_from_torch(blur_torch, 3, cpu) == 0.0
