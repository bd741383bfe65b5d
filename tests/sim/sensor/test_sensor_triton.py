"""The sensor's Triton kernel without a GPU: run by Triton's interpreter, and compiled for a GPU.

Each in a process of its own, because Triton reads TRITON_INTERPRET when it is imported.
"""

import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import product
from types import SimpleNamespace

import pytest
import torch

from src.sim.sensor.engines import sensor_cpu, sensor_eager
from src.sim.sensor.limits import MODES
from src.sim.sensor.sensor import EventSensor, _engine
from tests.sim.sensor.test_sensor import FPS, NOISY, signals

pytestmark = pytest.mark.skipif(not find_spec("triton"), reason="triton is not installed")
SETTINGS = {"clean": {}, "noisy": NOISY, "no dead time": {"refractory_s": 0.0}}


def in_a_process(check: str, **environment: str) -> None:
    """Call a function of this file in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", f"from tests.sim import test_sensor_triton as t; t.{check}"],
        env=os.environ | environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def in_two_chunks(engine, sensor, frames):
    """Return grids, of two intervals each, and the pixels' memory."""
    grids, state = [], None
    for part in (frames[:, :, :3], frames[:, :, 3:]):
        job = sensor._job(part, FPS, state, 2, origin=(5, 7), full_width=99)
        n, views, _, h, w = frames.shape
        grids.append(engine.voxels(job, torch.empty(n, views, job.intervals // 2, 5, h, w)))
        state = job.state
        state.frame += job.intervals
    return *grids, state.level, state.source, state.reference, state.dead


def agree() -> None:
    """Compare the kernel with the CPU's; four programs of 32 pixels, some beyond the picture."""
    from src.sim.sensor.engines import sensor_triton

    sensor_triton.BLOCK = 32
    frames = torch.stack([signals(seed, 5) for seed in range(2)])[None]
    for case in product(MODES, SETTINGS):
        sensor = EventSensor(0.2, refractory=case[0], **SETTINGS[case[1]])
        ours, theirs = (in_two_chunks(e, sensor, frames) for e in (sensor_triton, sensor_cpu))
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True)), case


def compiles() -> None:
    """Compile for compute capability 8.0: nothing fused, and divisions that round correctly."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from src.sim.sensor.engines.sensor_triton import _simulate

    names = _simulate.arg_names
    types = dict.fromkeys(names, "*i32") | {"wait": "fp32", "hots": "*i1"}
    types |= dict.fromkeys(("pixels", "samples", "intervals", "substeps"), "i32")
    types |= dict.fromkeys(("frames", "deads", "scales", "grids"), "*fp32")
    types |= dict.fromkeys(("ons", "offs", "numbering", "keys", "numbers", "clock"), "*i64")
    fixed = {"MODE": 2, "FRESH": 0, "FILTERED": True, "NOISY": True}
    fixed |= {"BINS": 5, "COLUMNS": 8, "BLOCK": 128}
    types |= dict.fromkeys(fixed, "constexpr")
    source = ASTSource(_simulate, types, {(names.index(name),): fixed[name] for name in fixed})
    options = {"enable_fp_fusion": False}
    ptx = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=options).asm["ptx"]
    assert "div.rn.f32" in ptx
    assert "fma." not in ptx and "div.full" not in ptx and "div.approx" not in ptx


def test_the_kernel_is_the_cpus_bit_for_bit():
    in_a_process("agree()", TRITON_INTERPRET="1")


def test_cuda_is_given_to_the_kernel_and_v2es_stamps_to_plain_torch():
    frames = SimpleNamespace(is_cuda=True)
    jobs = {
        stamps: EventSensor(stamps=stamps)._job(torch.zeros(1, 1, 2, 4, 4), FPS, None, 1)
        for stamps in ("linear", "v2e")
    }
    assert _engine(replace(jobs["linear"], frames=frames)).__name__.endswith("sensor_triton")
    assert _engine(replace(jobs["v2e"], frames=frames)) is sensor_eager


def test_the_kernel_compiles_for_a_gpu():
    in_a_process("compiles()")
