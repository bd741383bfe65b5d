"""What of the true picture is missing, by size of detail:

    python -m scripts.error_by_detail_size CKPT ... [--root PHOTOS]

Of validation clips of nine views, 176 x 176, 40 windows, as networks were trained on
(budget=hours); a picture counts after the best affine fit of its brightness, from window 10 on.  An
area that stays grey is missing at 16 pixels and more; LPIPS and SSIM hardly see it.
"""

import argparse

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src import models
from src.app import simulation
from src.app.compose import compose_config
from src.app.script import run_script
from src.metrics.image import align_brightness
from src.sim.pipeline import simulate

SIDES = (2, 4, 8, 16, 44)  # of blocks, in pixels
CLIPS, SIDE, WARMUP = 6, 176, 10


def missing(
    frames: Float[Tensor, "n 1 h w"], truth: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, " scales"]:
    """Return the power of the error relative to the truth's in details below each of SIDES, in
    pixels, and in what is left: 0 is perfect, 1 what grey has.
    """
    error = align_brightness(frames, truth) - truth
    parts = zip(_scales(error), _scales(truth - truth.mean((2, 3), keepdim=True)), strict=True)
    return torch.stack([wrong.square().mean() / true.square().mean() for wrong, true in parts])


def _scales(x: Tensor) -> list[Tensor]:
    parts = []
    for side in SIDES:
        blocks = functional.interpolate(functional.avg_pool2d(x, side), x.shape[-2:])
        parts.append(x - blocks)
        x = blocks
    return [*parts, x]


@torch.no_grad()
def main() -> None:
    """Print a row of a Markdown table for each network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ckpts", nargs="+")
    parser.add_argument("--root", default="../shared/data/photos")
    given = parser.parse_args()
    overrides = "budget=hours", f"scene.root={given.root}", f"data.test_crop={SIDE}"
    pipeline = simulation.build_pipeline(
        compose_config("train", "experiment=lf3x3", *overrides), "val"
    )
    networks, rows = [models.load(name) for name in given.ckpts], [[] for _ in given.ckpts]
    for clip in range(CLIPS):
        sample = simulate(pipeline, [clip])
        for network, row in zip(networks, rows, strict=True):
            frames = network.reconstruct_clip(sample)[0, WARMUP:]
            row.append(missing(frames, sample.target[0, WARMUP:]))
    print("| pixels | " + " | ".join([f"< {side}" for side in SIDES] + [f"> {SIDES[-1]}"]) + " |")
    print("|---" * (len(SIDES) + 2) + "|")
    for name, row in zip(given.ckpts, rows, strict=True):
        means = torch.stack(row).mean(0)
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in means) + " |")


if __name__ == "__main__":
    run_script(main)
