"""Begin a SetNet as a smaller one that is trained already:

    python -m scripts.widen_setnet experiment=setnet_large ckpt=FILE export=FILE

The wide network draws what the small one draws (Chen, Goodfellow & Shlens 2016, Net2Net): each new
channel is a copy of an old one, and whatever reads an old channel reads its copies in parts that
add up to what it read before.  The parts are drawn at random, for every reader anew, so that copies
learn different things from the first step.  A memory that is to have a rank gets it first
(`scripts.narrow_memory`), and then draws nearly what it did.  `export` is to go on from, with the
hours of `ckpt`: `python -m src.train ... ckpt=FILE`.  The config is that of the training.
"""

from itertools import pairwise
from pathlib import Path

import hydra
import torch
from jaxtyping import Float, Int
from omegaconf import DictConfig
from torch import Tensor, nn

from scripts.narrow_memory import narrow, told
from src.app import build, door
from src.models import files
from src.models.setnet import SetNet
from src.models.setnet_layers import Residual, ViewKernels
from src.training.handover import reached

SPREAD = 1.0  # a part is 1 / copies, give or take up to so much

Channels = Int[Tensor, " wide"]  # which old channel each new one is a copy of


def copies(old: int, new: int) -> Channels:
    """Return all old channels in order, then as many of them again as there are to be more."""
    if new < old:
        raise ValueError(f"a SetNet can be widened, not narrowed: {old} channels to {new}")
    more = [torch.randperm(old) for _ in range(new // old)]
    return torch.cat([torch.arange(old), *more])[:new]


def parts(channels: Channels, readers: int) -> Float[Tensor, "readers wide"]:
    """Return what each of `readers` takes of every new channel: 1 in all of the copies of one."""
    among = nn.functional.one_hot(channels).float()  # (wide, old)
    drawn = SPREAD * (2 * torch.rand(readers, len(channels)) - 1)
    mean = (drawn @ among) / among.sum(0)
    return drawn + ((1 / among.sum(0)) - mean)[:, channels]


@torch.no_grad()
def convolution(
    wide: nn.Conv2d, old: nn.Conv2d, reads: Channels | None, writes: Channels | None
) -> None:
    """Fill `wide`, which reads copies and writes copies (None: the channels are the same)."""
    kernel, bias = old.weight, old.bias
    if writes is not None:  # several groups of channels one after the other are copied alike
        groups = torch.arange(len(kernel) // (int(writes.max()) + 1))[:, None]
        rows = (groups * (int(writes.max()) + 1) + writes).flatten()
        kernel, bias = kernel[rows], None if bias is None else bias[rows]
    if reads is not None:
        kernel = kernel[:, reads] * parts(reads, len(kernel))[:, :, None, None]
    wide.weight.copy_(kernel)
    if bias is not None:
        wide.bias.copy_(bias)


def residual(wide: Residual, old: Residual, channels: Channels) -> None:
    """Fill `wide`, which reads copies and writes copies."""
    convolution(wide.first, old.first, channels, channels)
    convolution(wide.second, old.second, channels, channels)


@torch.no_grad()
def view_kernels(wide: ViewKernels, old: ViewKernels, writes: Channels) -> None:
    """Fill `wide`, which writes copies."""
    ranks = old.kernels.unflatten(0, (-1, len(old.bias)))
    wide.kernels.copy_(ranks[:, writes].flatten(0, 1))
    wide.bias.copy_(old.bias[writes])
    wide.code.load_state_dict(old.code.state_dict())


@torch.no_grad()
def widen(wide: SetNet, old: SetNet) -> None:
    """Fill `wide` so that it draws what `old` does; ValueError where it has less anywhere."""
    half = copies(old.half, wide.half)
    widths = [net.arguments["around"] for net in (old, wide)]
    if len(widths[0]) != len(widths[1]):
        raise ValueError(f"a SetNet is widened, not deepened: {widths[0]} to {widths[1]}")
    if old.arguments.get("refined") and not wide.arguments.get("refined"):
        raise ValueError("a SetNet is widened, not cut down: refined to not refined")
    rank, wanted = (net.arguments.get("rank") for net in (old, wide))
    if rank != wanted:
        raise ValueError(f"a SetNet is widened, not changed otherwise: rank {rank} to {wanted}")
    scales = [half, *(copies(a, b) for a, b in zip(*widths, strict=True))]
    view_kernels(wide.voxel_stem, old.voxel_stem, half)
    view_kernels(wide.sum_stem, old.sum_stem, half)
    convolution(wide.spread_stem, old.spread_stem, None, half)
    if rank:
        convolution(wide.cell2.mixed, old.cell2.mixed, half, None)
    convolution(wide.cell2.seen, old.cell2.seen, None if rank else half, half)
    convolution(wide.cell2.kept, old.cell2.kept, half, half)
    wide.around.pace.copy_(old.around.pace[half])
    for scale, (finer, here) in enumerate(pairwise(scales)):
        new, known = wide.around, old.around
        convolution(new.downs[scale], known.downs[scale], finer, here)
        residual(new.blocks[scale], known.blocks[scale], here)
        convolution(new.ups[scale], known.ups[scale], here, finer)
    if old.arguments.get("refined"):  # else these are new and silent
        met = zip(wide.around.joined, old.around.joined, scales[1:-1], strict=True)
        for new, known, here in met:
            residual(new, known, here)
    convolution(wide.mix2, old.mix2, half, half)
    convolution(wide.shuffle, old.shuffle, half, None)


def begin(cfg: DictConfig) -> None:
    """Read `cfg.ckpt`, write `cfg.export`."""
    if not (cfg.ckpt and cfg.export and files.exported(Path(cfg.export))):
        got = f"{cfg.ckpt} and {cfg.export}"
        raise ValueError(f"ckpt and export must be files, export a .safetensors, got {got}")
    wide, spec = build.network(cfg)
    source = Path(cfg.ckpt)
    old = files.load(source)
    if not (isinstance(old, SetNet) and isinstance(wide, SetNet)):
        kinds = f"{type(old).__name__} to {type(wide).__name__}"
        raise ValueError(f"ckpt and experiment must be SetNets, got {kinds}")
    torch.manual_seed(cfg.seed)
    rank = wide.arguments.get("rank")
    if rank and "rank" not in old.arguments:
        old = narrow(old, rank, told(old, cfg))
    widen(wide, old)
    files.save(Path(cfg.export), wide, spec, reached(source))


@hydra.main(version_base=None, config_path="../conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `begin`."""
    begin(cfg)


if __name__ == "__main__":
    door.run(main)
