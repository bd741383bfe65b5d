"""What of the true picture is missing, by size of detail:

    python -m scripts.error_by_detail_size CKPT ... [--root PHOTOS]

Of validation clips of nine views, of which a network gets those it wants, 176 x 176, 40 windows, as
networks were trained on (budget=hours); PHOTOS: a folder or a pack, without it the photographs in
scikit-image.  A picture counts after the best affine fit of its brightness, from window 10 on.  An
area that stays grey is missing at 16 pixels and more; LPIPS and SSIM hardly see it.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor
from torch.nn import functional

from src.app import simulation
from src.app.compose import compose_config
from src.app.methods import load_network_of_kind
from src.app.script import run_script
from src.metrics.image import align_brightness
from src.models.network import VideoMethod
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
def measure(cfg: DictConfig, names: Sequence[str]) -> dict[str, Float[Tensor, " scales"]]:
    """Return the mean of `missing` over the clips, of each network that one of `names` stands for;
    those of the same views are given the same clips.

    Raises ValueError for what is no network for events and for photographs that are none.
    """
    wanted = "CKPT must be a network"
    networks = {name: load_network_of_kind(VideoMethod, cfg, name, wanted) for name in names}
    optics = {name: simulation.select_optics(cfg, one) for name, one in networks.items()}
    try:
        pipelines = {one: simulation.build_pipeline(cfg, "val", one) for one in optics.values()}
    except ValueError as error:
        raise ValueError(str(error).replace("scene.root", "--root")) from error
    rows: dict[str, list[Tensor]] = {name: [] for name in names}
    for clip in range(CLIPS):
        samples = {one: simulate(pipeline, [clip]) for one, pipeline in pipelines.items()}
        for name, network in networks.items():
            sample = samples[optics[name]]
            frames = network.reconstruct_clip(sample)[0, WARMUP:]
            rows[name].append(missing(frames, sample.target[0, WARMUP:]))
    return {name: torch.stack(row).mean(0) for name, row in rows.items()}


def main() -> None:
    """Print a row of a Markdown table for each network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ckpts", nargs="+", metavar="CKPT")
    parser.add_argument("--root", type=Path, metavar="PHOTOS")
    given = parser.parse_args()
    cfg = compose_config("train", "experiment=lf3x3", "budget=hours", f"data.test_crop={SIDE}")
    cfg.scene.root = str(given.root) if given.root else None
    means = measure(cfg, given.ckpts)
    print("| pixels | " + " | ".join([f"< {side}" for side in SIDES] + [f"> {SIDES[-1]}"]) + " |")
    print("|---" * (len(SIDES) + 2) + "|")
    for name, row in means.items():
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in row) + " |")


if __name__ == "__main__":
    run_script(main)
