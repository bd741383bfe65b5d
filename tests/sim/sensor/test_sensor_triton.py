"""The sensor's Triton kernel without a GPU: run by Triton's interpreter, and compiled for a GPU.

Each in a process of its own, because Triton reads TRITON_INTERPRET when it is imported.
"""

import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace

import pytest
import torch

from src.sim.sensor.engines import sensor_cpu, sensor_eager
from src.sim.sensor.engines.run import engine
from src.sim.sensor.limits import MODES
from src.sim.sensor.sensor import EventSensor
from tests.sim.sensor.test_batch import clips, in_two_chunks, sensors
from tests.sim.sensor.test_sensor import FPS

pytestmark = pytest.mark.skipif(not find_spec("triton"), reason="triton is not installed")


def in_a_process(check: str, **environment: str) -> None:
    """Call a function of this file in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", f"from tests.sim.sensor import test_sensor_triton as t; t.{check}"],
        env=os.environ | environment, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def agree() -> None:
    """Compare the kernel with the CPU's; 16 programs of 32 pixels, some beyond the picture.

    The sensors of a batch differ in all that may, or are without noise and low-pass.  Frames are
    float16 and float32, and lie in memory in another order.
    """
    from src.sim.sensor.engines import sensor_triton

    sensor_triton.BLOCK = 32
    turned = clips(5).permute(2, 4, 0, 3, 1).contiguous().permute(2, 4, 0, 3, 1)
    cases = [(sensors(True, refractory=mode), turned.half()) for mode in MODES]
    for many, frames in (*cases, (sensors(False)[:2] * 2, turned)):
        ours, theirs = (in_two_chunks(e, many, frames) for e in (sensor_triton, sensor_cpu))
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True)), vars(many[0])


def refuses() -> None:
    """Raise for one pixel of one clip that is no intensity, first frame or later."""
    from src.sim.sensor.engines import sensor_triton

    for frame in (0, 4):
        frames = clips(5)
        in_two_chunks(sensor_triton, sensors(False), frames)
        frames[3, 1, frame, 5, 7] = float("nan")
        with pytest.raises(ValueError, match="frames must be finite"):
            in_two_chunks(sensor_triton, sensors(False), frames)


def compiles() -> None:
    """Compile for compute capability 8.0: nothing fused, and divisions that round correctly."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from src.sim.sensor.engines.sensor_triton import SIZES, _simulate

    names = _simulate.arg_names
    fixed = {"MODE": 2, "FILTERED": True, "NOISY": True, "BINS": 5, "COLUMNS": 8, "BLOCK": 128}
    types = dict.fromkeys(names, "*i32") | dict.fromkeys(SIZES, "i32")
    types |= dict.fromkeys(("deads", "grids"), "*fp32")
    types |= dict.fromkeys(("normals", "numbers"), "*i64")
    types |= dict.fromkeys((*fixed, "FRESH"), "constexpr")
    options = {"enable_fp_fusion": False}
    for fresh, frames in ((True, "*fp16"), (False, "*fp32")):
        values = {(names.index(name),): value for name, value in (fixed | {"FRESH": fresh}).items()}
        source = ASTSource(_simulate, types | {"frames": frames}, values)
        ptx = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=options).asm["ptx"]
        assert "div.rn.f32" in ptx
        assert "fma." not in ptx and "div.full" not in ptx and "div.approx" not in ptx


def test_the_kernel_is_the_cpus_bit_for_bit():
    in_a_process("agree()", TRITON_INTERPRET="1")


def test_the_kernel_says_what_is_no_intensity():
    in_a_process("refuses()", TRITON_INTERPRET="1")


def test_cuda_is_given_to_the_kernel_and_v2es_stamps_to_plain_torch():
    frames = SimpleNamespace(is_cuda=True, device=torch.device("cuda"))
    jobs = {
        stamps: EventSensor(stamps=stamps)._job(torch.zeros(1, 1, 2, 4, 4), FPS, None, 1)
        for stamps in ("linear", "v2e")
    }
    assert engine(replace(jobs["linear"], frames=frames)).__name__.endswith("sensor_triton")
    assert engine(replace(jobs["v2e"], frames=frames)) is sensor_eager


def test_the_kernel_compiles_for_a_gpu():
    in_a_process("compiles()")
