"""Turbulence for nine views: python -m benchmarks.turbulence [what ...] [another checkout]

`table`: ms a frame of 256x256, clips of 4 frames, two threads, where turbulence is local: a pixel
of 0.04 to 0.4 D at the object, D/r0 0.5 to 4, D^2 / (lambda L) = 4.7, so lambda / D is 0.21 /
pixel. Limits: 60 ms at 0.08 D and more, 1.5 GB. `prior`: seconds of one thread for a training clip,
25 frames of 80x80, over the turbulence that training draws; limit 0.6 s on average. These two by
default. Another checkout of this repository, of version 0.2 or later, is timed beside this one: the
two take turns. Times are wall time in `table`, the least of three, and CPU time of the thread in
`prior`. `launches`: what a device has to do for a clip of a cache, 41 frames of 144x144, over the
same turbulence: operators, gigabytes they read and write and products, and the ms that LAUNCH_S,
BYTES_S and PRODUCTS_S make of these, an H100's; limit 8 ms. With CUDA: those ms as they are.
"""

import argparse
import json
import math
import os
import resource
import statistics
import subprocess
import sys
import time
from dataclasses import astuple
from pathlib import Path
from types import ModuleType

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from src.sim.turbulence import Atmosphere, Turbulence, sample_atmosphere

APERTURE_M, WAVELENGTH_M, FRESNEL = 0.1, 525e-9, 4.7
PIXELS, STRENGTHS = (0.04, 0.08, 0.16, 0.4), (0.5, 2.0, 4.0)  # of D at the object; D/r0
CLIPS = 20
CACHED, CROP = (1, 41, 256, 256), (56, 56, 144, 144)  # a clip of a cache: frames, what is kept
LAUNCH_S, BYTES_S, PRODUCTS_S = 10e-6, 2e12, 20e12  # a launch; bytes and float32 products a second
FREE = {"empty", "new_empty", "empty_strided", "_unsafe_view", "detach", "lift_fresh", "arange"}


def local_atmosphere(pixel: float, d_over_r0: float) -> list:
    """Return the values of an Atmosphere with pixels of `pixel` D at the object."""
    lambda_over_d_px = 1 / (pixel * FRESNEL)
    distance = lambda_over_d_px * pixel * APERTURE_M**2 / WAVELENGTH_M
    width = 256 * pixel * APERTURE_M
    path = Atmosphere(APERTURE_M, 0.5, distance, width, WAVELENGTH_M, 1e-14, 0.9)
    return list(astuple(path.with_d_over_r0(d_over_r0)))


def frame_ms(atmosphere: list) -> float:
    """Return wall ms for a frame of nine views of 256x256."""
    torch.set_num_threads(2)
    turbulence = Turbulence(Atmosphere(*atmosphere), views=9, height=256, width=256)
    frames, taken = torch.rand(1, 4, 256, 256), []
    for _ in range(3):
        start = time.perf_counter()
        turbulence.degrade(frames, torch.Generator().manual_seed(0))
        taken.append(time.perf_counter() - start)
    return 1e3 * min(taken) / 4


def clip_s(atmosphere: list) -> float:
    """Return seconds of one thread for a training clip, from the atmosphere on."""
    torch.set_num_threads(1)
    frames, path = torch.rand(1, 25, 256, 256), Atmosphere(*atmosphere)
    start = time.thread_time()
    turbulence = Turbulence(path, views=9, height=256, width=256)
    turbulence.degrade(frames, torch.Generator().manual_seed(0), crop=(70, 70, 80, 80))
    return time.thread_time() - start


def draw_atmospheres() -> list[Atmosphere]:
    """Return random atmospheres as training sees them (turbulence=mixed)."""
    return [sample_atmosphere("mixed", torch.Generator().manual_seed(n)) for n in range(CLIPS)]


class Checkout:
    """A process that times the code of one checkout, when asked to.

    It runs this file, which therefore imports above only what versions from 0.2 on have.
    """

    def __init__(self, root: Path):
        self.root, here = root, Path(__file__).resolve()
        self.process = subprocess.Popen(
            [sys.executable, str(here), "serve"],
            cwd=root,
            env=os.environ | {"PYTHONPATH": str(root)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, work: str, *numbers: object) -> float:
        """Return what `work` (frame_ms, clip_s or memory_gb) gives for the numbers.

        Raises ValueError where the process has ended, on code that this file does not fit.
        """
        try:
            print(json.dumps([work, *numbers]), file=self.process.stdin, flush=True)
            return json.loads(self.process.stdout.readline())
        except (BrokenPipeError, json.JSONDecodeError):
            raise ValueError(f"{self.root}: this checkout cannot be timed (see above)") from None


def memory_gb() -> float:
    """Return the most memory that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def serve() -> None:
    """Answer a parent's questions."""
    known = {"frame_ms": frame_ms, "clip_s": clip_s, "memory_gb": memory_gb}
    for line in sys.stdin:
        work, *numbers = json.loads(line)
        print(json.dumps(known[work](*numbers)), flush=True)


def table(checkouts: list[Checkout]) -> None:
    """Print ms a frame per pixel and strength, ours first."""
    for pixel in PIXELS:
        for strength in STRENGTHS:
            given = local_atmosphere(pixel, strength)
            ms = [checkout("frame_ms", given) for checkout in checkouts]
            print(f"pixel {pixel} D, D/r0 {strength}:", *(f"{m:.0f} ms" for m in ms), flush=True)
    print("most memory:", *(f"{checkout('memory_gb'):.2f} GB" for checkout in checkouts))


def prior(checkouts: list[Checkout]) -> None:
    """Print mean and 90 % quantile of the seconds of a training clip, ours first."""
    known = [list(astuple(path)) for path in draw_atmospheres()]
    for checkout in checkouts:
        checkout("clip_s", known[0])  # compiles
    taken = [[checkout("clip_s", drawn) for checkout in checkouts] for drawn in known]
    for own in zip(*taken, strict=True):
        tenth = statistics.quantiles(own, n=10)[-1]
        print(f"training clip: mean {statistics.mean(own):.2f} s, 90 % below {tenth:.2f} s")


class Work(TorchDispatchMode):
    """Counts what a device would do: operators that are no views, the bytes of their tensors, and
    products of matrices.
    """

    def __init__(self):
        super().__init__()
        self.launches = self.bytes = self.products = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Count an operator and do it."""
        out = func(*args, **kwargs or {})
        name = func._schema.name.split("::")[1]
        if not func.is_view and name not in FREE:
            self.launches += 1
            self.bytes += sum(part.nbytes for part in (*args, out) if isinstance(part, Tensor))
            if name in ("mm", "bmm"):
                self.products += out.numel() * args[0].shape[-1]
        return out


def kernels(work: Work) -> ModuleType:
    """Return an engine that costs what Triton's two kernels do, and gives nothing of use."""
    engine = ModuleType("kernels")

    def warp_cubic(frames: Tensor, tilt: Tensor, *_) -> Tensor:
        torch.aminmax(frames.flatten(1), dim=1)
        return tilt[0] + tilt[1]

    def scatter_normalised(image: Tensor, psfs: Tensor, rows, halo: Tensor, *_) -> Tensor:
        work.bytes += psfs.nbytes
        return image[:, : halo.shape[1], : halo.shape[2]] + 1

    engine.WARP_NUMBERS, engine.SCATTER_NUMBERS = 8, 0
    engine.warp_cubic, engine.scatter_normalised = warp_cubic, scatter_normalised
    return engine


def launches() -> None:
    """Print what a device has to do for a clip of a cache, on average."""
    from src.sim.turbulence import clip_rendering
    from src.sim.turbulence.engines import device

    frames, done, chosen = torch.rand(CACHED), [], device.select_blur_engine
    for prepared in prepare_clips():
        with Work() as work:
            device.select_blur_engine = lambda device, work=work: kernels(work)
            clip_rendering.render_views(frames[0], prepared.plans, use_cpu_engines=False)
        ms = [work.launches * LAUNCH_S, work.bytes / BYTES_S, work.products / PRODUCTS_S]
        done.append((work.launches, work.bytes / 1e9, work.products / 1e9, 1e3 * math.fsum(ms)))
    device.select_blur_engine = chosen
    count, gb, products, ms = map(statistics.mean, zip(*done, strict=True))
    print(f"a clip: {count:.0f} launches, {gb:.1f} GB, {products:.0f} G products: {ms:.1f} ms")
    print(f"most: {max(one[0] for one in done)} launches, {max(one[-1] for one in done):.1f} ms")


def prepare_clips() -> list:
    """Return random turbulence as training sees it, ready for a device."""
    from src.training.parallel_fill import prepare_turbulence

    operators = [Turbulence(path, views=9, height=256, width=256) for path in draw_atmospheres()]
    return [
        prepare_turbulence(one, CACHED[1], torch.Generator().manual_seed(0), CROP)
        for one in operators
    ]


def cuda() -> None:
    """Print the ms that a clip of a cache takes the first CUDA device, on average."""
    from src.sim.turbulence.engines import device

    frames, clips, taken = torch.rand(CACHED, device="cuda"), prepare_clips(), []
    for _ in range(4):
        start = time.perf_counter()
        for prepared in clips:
            prepared.degrade(frames, torch.Generator(), crop=CROP)
        torch.cuda.synchronize()
        taken.append((time.perf_counter() - start) / len(clips))
    engine = device.select_blur_engine(frames.device).__name__.rpartition(".")[2]
    print(f"CUDA: {1e3 * min(taken):.1f} ms for a clip of a cache ({engine})")


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", help="table, prior, launches, folders of checkouts")
    words = parser.parse_args().words
    parts = [word for word in words if word in ("table", "prior", "launches")]
    others = [Path(word).resolve() for word in words if word not in parts]
    if missing := [str(root) for root in others if not root.is_dir()]:
        parser.error(f"a word must be table, prior, launches or a folder, got {missing[0]}")
    roots = [Path.cwd(), *others]
    checkouts = [Checkout(root) for root in roots]
    for part in parts or ("table", "prior"):
        launches() if part == "launches" else {"table": table, "prior": prior}[part](checkouts)
    for checkout in checkouts:
        checkout.process.communicate()  # ends it
    if torch.cuda.is_available():
        cuda()


if __name__ == "__main__":
    if sys.argv[1:] == ["serve"]:
        serve()
    else:
        from src.app.script import run_script

        run_script(main)
