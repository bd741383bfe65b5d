"""Turbulence for nine views: python -m benchmarks.turbulence

Limits, two threads: 256x256 at D/r0 = 2 in 120 ms and 1.5 GB, 112x112 in 25 ms, 64x64 in 8 ms;
D/r0 = 0.5 at most a third of D/r0 = 4; with CUDA 3,000 view-frames per second.  The ratio is to a
naive simulator in the same run: a 33-200-200-100 network at every pixel and 100 bases convolved at
full resolution with the picture and with white.  `real` is wall time on the machine's threads,
`thread` CPU time of one thread; both are the least of several repeats.
"""

import resource
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import nn

from benchmarks.timing import least
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.operator import Turbulence

CAMERA = Atmosphere(0.1, 0.5, 300.0, 0.4, 525e-9, 1e-14, 0.9)
BASES, SUPPORT, PAD = 100, 33, 32


def at(d_over_r0: float, pixel: float = 0.04) -> Turbulence:
    """Return nine views of 256x256 with lambda / D = one pixel of `pixel` D at the object."""
    distance = pixel * CAMERA.aperture_m**2 / CAMERA.wavelength_m
    path = replace(CAMERA, distance_m=distance, scene_width_m=256 * pixel * CAMERA.aperture_m)
    return Turbulence(path.at(d_over_r0), views=9, height=256, width=256)


def naive() -> Callable[[], object]:
    """Return the naive simulation of one view, one 256x256 frame, phase given."""
    net = nn.Sequential(
        nn.Linear(33, 200),
        nn.LeakyReLU(),
        nn.Linear(200, 200),
        nn.LeakyReLU(),
        nn.Linear(200, BASES),
    )
    size = 256 + PAD
    phase, picture = torch.randn(256 * 256, 33), torch.rand(256, 256)
    basis = torch.fft.rfft2(torch.randn(BASES, SUPPORT, SUPPORT), s=(size, size))

    @torch.no_grad()
    def work() -> torch.Tensor:
        weights = net(phase).T.reshape(BASES, 256, 256)
        light, white = (
            torch.fft.irfft2((torch.fft.rfft2(share, s=(size, size)) * basis).sum(0))
            for share in (weights * picture, weights)
        )
        return light / white

    return work


def rows(reference: float) -> None:
    """Print time per frame of nine views, whole and cropped."""
    frames = torch.rand(1, 1, 256, 256)
    for pixel in (0.04, 0.0156):
        for strength in (0.5, 2.0, 4.0, 8.0):
            turbulence = at(strength, pixel)
            for side in (256, 112, 64):
                crop = (70, 70, side, side) if side < 256 else None

                def work(run=turbulence, crop=crop):
                    return run.degrade(frames, torch.Generator().manual_seed(0), crop=crop)

                real = least(work, time.perf_counter, 8)
                print(
                    f"pixel {pixel} D, D/r0 {strength}, {side}x{side}: {1e3 * real:.1f} ms real, "
                    f"{reference / real:.0f} times faster than naive at 256x256"
                )


def one_thread() -> None:
    """Print CPU time on one thread: the frame, its parts' choice, and a training clip."""
    torch.set_num_threads(1)
    frames, clip = torch.rand(1, 1, 256, 256), torch.rand(1, 33, 256, 256)
    for strength in (0.5, 2.0, 4.0, 8.0):
        turbulence = at(strength)

        def work(run=turbulence):
            return run.degrade(frames, torch.Generator().manual_seed(0))

        print(f"D/r0 {strength}, 256x256: {1e3 * least(work):.0f} ms thread")
    for strength, pixel, side in ((2.0, 0.04, 64), (4.0, 0.0156, 112)):
        turbulence, crop = at(strength, pixel), (70, 70, side, side)
        for part in (frames, clip):

            def work(run=turbulence, crop=crop, part=part):
                return run.degrade(part, torch.Generator().manual_seed(0), crop=crop)

            ms = 1e3 * least(work, repeats=4) / part.shape[1]
            print(
                f"pixel {pixel} D, D/r0 {strength}, {side}x{side}, clip of {part.shape[1]}: "
                f"{ms:.1f} ms thread a frame"
            )
    start = least(lambda: at(2.0))
    print(f"choice of fidelity: {1e3 * start:.1f} ms thread")


def cuda() -> None:
    """Print view-frames per second on the first CUDA device."""
    turbulence, frames = at(2.0), torch.rand(1, 32, 256, 256, device="cuda")

    def work():
        turbulence.degrade(frames, torch.Generator().manual_seed(0))
        torch.cuda.synchronize()

    rate = 9 * 32 / least(work, time.perf_counter, 8)
    print(f"CUDA: {rate:.0f} view-frames per second at 256x256, D/r0 = 2")


if __name__ == "__main__":
    reference = 9 * least(naive(), time.perf_counter, 2)
    print(f"naive, nine views of 256x256, phase given: {1e3 * reference:.0f} ms real")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rows(reference)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"most memory {after / 1e6:.2f} GB ({before / 1e6:.2f} GB before)")
    one_thread()
    if torch.cuda.is_available():
        cuda()
