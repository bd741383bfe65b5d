"""The sensor's Triton kernel without a GPU: run by Triton's interpreter, and compiled for a GPU.

Each in a process of its own, because Triton reads TRITON_INTERPRET when it is imported.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace

import pytest
import torch

from src.sim.sensor.engine_input import MODES, build_engine_input
from src.sim.sensor.engines import sensor_cpu
from src.sim.sensor.engines.run import uses_triton
from src.sim.sensor.sensor import EventSensor
from tests.sim.sensor.test_batch import VIEWS, clips, sensor_clips, sensors
from tests.sim.sensor.test_sensor import FPS

pytestmark = pytest.mark.skipif(not find_spec("triton"), reason="triton is not installed")


def in_a_process(check: Callable, **environment: str) -> None:
    """Call a function of a test file in a process of its own."""
    code = f"import {check.__module__} as tests; tests.{check.__name__}()"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def simulated(engine: ModuleType, many: list[EventSensor], frames: torch.Tensor) -> torch.Tensor:
    """Grids of two intervals each."""
    given = build_engine_input(sensor_clips(many), frames, VIEWS, substeps=2)
    grids = torch.zeros(4, (frames.shape[2] - 1) // 2, 2, 5, *frames.shape[-2:])
    return engine.voxels(given, grids)


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
        ours, theirs = (simulated(e, many, frames) for e in (sensor_triton, sensor_cpu))
        assert torch.equal(ours, theirs) and ours.any(), vars(many[0])


def refuses() -> None:
    """Raise for one pixel of one clip that is no intensity, first frame or later."""
    from src.sim.sensor.engines import sensor_triton

    for frame in (0, 4):
        frames = clips(5)
        simulated(sensor_triton, sensors(False), frames)
        frames[3, 1, frame, 5, 7] = float("nan")
        with pytest.raises(ValueError, match="frames must be finite"):
            simulated(sensor_triton, sensors(False), frames)


def compiles() -> None:
    """Compile for compute capability 8.0: nothing fused, and divisions that round correctly."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from src.sim.sensor.engines.sensor_triton import SIZES, _simulate

    names = _simulate.arg_names
    fixed = {"MODE": 2, "FILTERED": True, "NOISY": True, "BINS": 5, "COLUMNS": 8, "BLOCK": 128}
    types = dict.fromkeys(names, "*i32") | dict.fromkeys(SIZES, "i32")
    types |= {"grids": "*fp32", "normals": "*i64", "numbers": "*i64"}
    types |= dict.fromkeys(fixed, "constexpr")
    options = {"enable_fp_fusion": False}
    values = {(names.index(name),): value for name, value in fixed.items()}
    for frames in ("*fp16", "*fp32"):
        source = ASTSource(_simulate, types | {"frames": frames}, values)
        ptx = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=options).asm["ptx"]
        assert "div.rn.f32" in ptx
        assert "fma." not in ptx and "div.full" not in ptx and "div.approx" not in ptx


def test_the_kernel_is_the_cpus_bit_for_bit():
    in_a_process(agree, TRITON_INTERPRET="1")


def test_the_kernel_says_what_is_no_intensity():
    in_a_process(refuses, TRITON_INTERPRET="1")


def test_cuda_is_given_to_the_kernel_and_v2es_stamps_to_the_cpu():
    for stamps, wanted in (("linear", True), ("v2e", False)):
        given = EventSensor(stamps=stamps)._engine_input(torch.zeros(1, 1, 2, 4, 4), FPS)
        assert not uses_triton(given)
        assert uses_triton(given._replace(frames=SimpleNamespace(is_cuda=True))) == wanted


def test_the_kernel_compiles_for_a_gpu():
    in_a_process(compiles)
