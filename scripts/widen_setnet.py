"""Begin a SetNet as a smaller one that is trained already:

    python -m scripts.widen_setnet experiment=setnet_large ckpt=FILE export=FILE

The wide network draws what the small one draws (Chen, Goodfellow & Shlens 2016, Net2Net): each new
channel is a copy of an old one, and whatever reads an old channel reads its copies in parts that
add up to what it read before.  The parts are drawn at random, for every reader anew, so that copies
learn different things from the first step.  A memory in full is first factored into one of as many
ranks as it has gates and candidates, which is the same.  `export` is to go on from, with the
hours of `ckpt`: `python -m src.train ... ckpt=FILE`.  The config is that of the training.
"""

from itertools import pairwise
from pathlib import Path

import hydra
import torch
from jaxtyping import Float, Int
from omegaconf import DictConfig
from torch import Tensor, nn

from src.app import build, entry_point
from src.app.renamed_keys import refuse_renamed_keys
from src.models import files
from src.models.layers import PreActivationBlock
from src.models.setnet import SetNet
from src.models.view_kernels import ViewKernels
from src.training.learning_curve import read_training_progress

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


def residual(wide: PreActivationBlock, old: PreActivationBlock, channels: Channels) -> None:
    """Fill `wide`, which reads copies and writes copies."""
    convolution(wide.conv1, old.conv1, channels, channels)
    convolution(wide.conv2, old.conv2, channels, channels)


@torch.no_grad()
def view_kernels(wide: ViewKernels, old: ViewKernels, writes: Channels) -> None:
    """Fill `wide`, which writes copies."""
    ranks = old.basis.unflatten(0, (-1, len(old.bias)))
    wide.basis.copy_(ranks[:, writes].flatten(0, 1))
    wide.bias.copy_(old.bias[writes])
    wide.code.load_state_dict(old.code.state_dict())


@torch.no_grad()
def widen(wide: SetNet, old: SetNet) -> None:
    """Fill `wide` so that it draws what `old` does; ValueError where it has less anywhere."""
    half = copies(old.channels, wide.channels)
    widths = [net.init_kwargs["context_channels"] for net in (old, wide)]
    if len(widths[0]) != len(widths[1]):
        raise ValueError(f"a SetNet is widened, not deepened: {widths[0]} to {widths[1]}")
    if old.init_kwargs["refine_fusion"] and not wide.init_kwargs["refine_fusion"]:
        raise ValueError("a SetNet is widened, not cut down: refined to not refined")
    rank, wanted = (net.init_kwargs["gate_rank"] for net in (old, wide))
    if rank != wanted:
        raise ValueError(f"a SetNet is widened, not changed otherwise: rank {rank} to {wanted}")
    scales = [half, *(copies(a, b) for a, b in zip(*widths, strict=True))]
    view_kernels(wide.voxel_kernels, old.voxel_kernels, half)
    view_kernels(wide.sum_kernels, old.sum_kernels, half)
    convolution(wide.spread_conv, old.spread_conv, None, half)
    if rank:
        convolution(wide.memory.input_features, old.memory.input_features, half, None)
    convolution(wide.memory.input_gates, old.memory.input_gates, None if rank else half, half)
    convolution(wide.memory.state_gates, old.memory.state_gates, half, half)
    wide.context.log_rate.copy_(old.context.log_rate[half])
    for scale, (finer, here) in enumerate(pairwise(scales)):
        new, known = wide.context, old.context
        convolution(new.downs[scale], known.downs[scale], finer, here)
        residual(new.down_blocks[scale], known.down_blocks[scale], here)
        convolution(new.ups[scale], known.ups[scale], here, finer)
    if old.init_kwargs["refine_fusion"]:  # else these are new and silent
        met = zip(wide.context.fusion_blocks, old.context.fusion_blocks, scales[1:-1], strict=True)
        for new, known, here in met:
            residual(new, known, here)
    convolution(wide.decoder_conv, old.decoder_conv, half, half)
    convolution(wide.pixel_conv, old.pixel_conv, half, None)


def factored(network: SetNet) -> SetNet:
    """Return the same network, its memory of rank 2 * half: each gate and candidate of its own."""
    rank, weights = 2 * network.channels, network.state_dict()
    weights["memory.input_features.weight"] = weights["memory.input_gates.weight"]
    weights["memory.input_gates.weight"] = torch.eye(rank)[..., None, None]
    same = SetNet(**network.init_kwargs | {"gate_rank": rank})
    same.load_state_dict(weights)
    return same


def begin(cfg: DictConfig) -> None:
    """Read `cfg.ckpt`, write `cfg.export`."""
    if not (cfg.ckpt and cfg.export and files.is_weights_file(Path(cfg.export))):
        got = f"{cfg.ckpt} and {cfg.export}"
        raise ValueError(f"ckpt and export must be files, export a .safetensors, got {got}")
    wide, spec = build.build_untrained_network(cfg)
    source = files.locate(cfg.ckpt)
    old = files.load(source)
    if not (isinstance(old, SetNet) and isinstance(wide, SetNet)):
        kinds = f"{type(old).__name__} to {type(wide).__name__}"
        raise ValueError(f"ckpt and experiment must be SetNets, got {kinds}")
    torch.manual_seed(cfg.seed)
    if wide.init_kwargs["gate_rank"] and not old.init_kwargs["gate_rank"]:
        old = factored(old)
    widen(wide, old)
    files.save(Path(cfg.export), wide, spec, read_training_progress(source))


@hydra.main(version_base=None, config_path="../conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `begin`."""
    refuse_renamed_keys(cfg)
    begin(cfg)


if __name__ == "__main__":
    entry_point.run_main(main)
