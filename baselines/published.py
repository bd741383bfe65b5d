"""Published checkpoints as networks of ours: only names differ, by the rules below."""

import re
from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from baselines.cista import CISTA
from baselines.e2vid_plus import E2VIDPlus
from baselines.etnet import ETNet
from baselines.firenet import FireNet
from baselines.hypere2vid import HyperE2VID
from baselines.pickled_weights import read_pickled_tensors
from baselines.pienet import PIENet
from src import COMMAND
from src.models import files

# Ours -> published, one rule after the other.
UNET = (
    (r"^net\.encoders\.(\d)\.", r"unetrecurrent.encoders.\1.conv.conv2d."),
    (r"^net\.cells\.(\d)\.gates\.", r"unetrecurrent.encoders.\1.recurrent_block.Gates."),
    (r"^net\.resblocks\.", "unetrecurrent.resblocks."),
    (r"^net\.(head|decoders\.\d|pred)\.", r"unetrecurrent.\1.conv2d."),
)
FIRENET = (
    (r"^head\.", "net.head.conv.conv2d."),
    (r"^cells\.0\.", "net.head.recurrent_block."),
    (r"^resblocks\.0\.", "net.resblocks.0.conv."),
    (r"^cells\.1\.", "net.resblocks.0.recurrent_block."),
    (r"^resblocks\.1\.", "net.resblocks.1."),
    (r"^pred\.", "net.pred.conv2d."),
)
FIRENET_PLUS = (
    (r"^(head|pred)\.", r"\1.conv2d."),
    (r"^cells\.0\.", "G1."),
    (r"^resblocks\.0\.", "R1."),
    (r"^cells\.1\.", "G2."),
    (r"^resblocks\.1\.", "R2."),
)
ETNET = (
    (r"^net\.(head|pred)\.", r"\1.conv2d."),
    (r"^net\.encoders\.(\d)\.", r"DownsampleConv.\1.conv.conv2d."),
    (r"^net\.cells\.(\d)\.gates\.", r"DownsampleConv.\1.recurrent_block.Gates."),
    (r"^net\.decoders\.(\d)\.", r"UpsampleConv.\1.conv2d."),
    (r"^pyramid\.split\.0\.", "split1."),
    (r"^pyramid\.split\.1\.", "split2."),
    (r"\.attention\.project\.", ".self_attn.in_proj_"),
    (r"\.attention\.out\.", ".self_attn.out_proj."),
    (r"\.cross\.project\.", ".cross_attn.in_proj_"),
    (r"\.cross\.out\.", ".cross_attn.out_proj."),
    (r"\.asker_norm\.", ".norm21."),
    (r"\.memory_norm\.", ".norm22."),
    (r"\.mlp\.wide\.", ".linear1."),
    (r"\.mlp\.back\.", ".linear2."),
    (r"^(pyramid\.own\..*)\.mlp\.norm\.", r"\1.norm2."),
    (r"^(pyramid\.across\..*)\.mlp\.norm\.", r"\1.norm3."),
    (r"\.norm\.", ".norm1."),
    (r"^pyramid\.own\.(\d)\.(\d)\.", r"trans_encoder\1.encoder.layers.\2."),
    (r"^pyramid\.across\.(\d)\.(\d)\.", r"trans_decoder\1.decoder.layers.\2."),
)
HYPER = (
    (r"^net\.decoders\.0\.", "unetrecurrent.decoders.1.conv2d."),
    (r"^net\.decoders\.1\.", "unetrecurrent.decoders.2.conv2d."),
    (r"^dynamic\.fuse\.", "unetrecurrent.decoders.0.context_fusion.conv."),
    (r"^dynamic\.weigh\.", "unetrecurrent.decoders.0.dynamic_atom_generation.bases_net."),
    (r"^dynamic\.functions", "unetrecurrent.decoders.0.dynamic_atom_generation.bases"),
    (r"^dynamic\.compose\.", "unetrecurrent.decoders.0.dynamic_conv."),
    (r"dynamic_conv\.weight", "dynamic_conv.compositional_coefficients"),
    *UNET,
)
CISTA_TC = (
    (r"^events\.", "We.conv2d."),
    (r"^previous\.", "Wi.conv2d."),
    (r"^mix\.", "W0.conv2d."),
    (r"^encode\.", "P0.conv2d."),
    (r"^steps\.(\d)\.threshold", r"lista_blocks.\1.Lambda"),
    (r"^steps\.(\d)\.synthesis\.", r"lista_blocks.\1.D.conv2d."),
    (r"^steps\.(\d)\.analysis\.", r"lista_blocks.\1.P.conv2d."),
    (r"^agree_before\.", "one_conv_for_prev.conv2d."),
    (r"^agree_now\.", "one_conv_for_cur.conv2d."),
    (r"^pulls\.", "alpha."),
    (r"^decoder\.", "Dg.conv.conv2d."),
    (r"^cell\.gates\.", "Dg.recurrent_block.Gates."),
    (r"^up\.", "upsamp_conv.conv2d."),
    (r"^pred\.", "final_conv.conv2d."),
)
PIENET = (
    (r"^(events|previous)\.", r"stem.\1_branch.mbconv."),
    (r"^stem\.previous", "stem.frame"),
    (r"^stem\.events", "stem.event"),
    (r"^encoders\.(\d)\.widen\.", r"downs.\1.mbd.Gates.mbconv.0."),
    (r"^encoders\.(\d)\.weigh\.squeeze\.", r"downs.\1.mbd.Gates.mbconv.1.fc1."),
    (r"^encoders\.(\d)\.weigh\.excite\.", r"downs.\1.mbd.Gates.mbconv.1.fc2."),
    (r"^encoders\.(\d)\.gates\.", r"downs.\1.mbd.Gates.mbconv.2.convna."),
    (r"^encoders\.(\d)\.hidden_norm\.", r"downs.\1.mbd.norm_h."),
    (r"^encoders\.(\d)\.cell_norm\.", r"downs.\1.mbd.norm_c."),
    (r"^encoders\.(\d)\.refine\.", r"downs.\1.out.mbconv_0.mbconv."),
    (r"^encoders\.(\d)\.modulate\.", r"downs.\1.film.film."),
    (r"^decoders\.(\d)\.gate\.", r"ups.\1.ugate.gate_conv."),
    (r"^decoders\.(\d)\.fuse\.", r"ups.\1.fuse.0.mbconv."),
    (r"^pred\.", "outc."),
    (r"^(stem|downs|ups|outc)\.", r"model.\1."),
    (r"^offset\.", "cal_k.mbconv."),
    (r"mbconv\.(\d\.)?conv\.", r"mbconv.\1convna.0."),
    (r"mbconv\.(\d\.)?norm\.", r"mbconv.\1convna.1."),
)


OURS = (".safetensors", ".ckpt")  # what src.models.files reads


class PublishedNetwork(NamedTuple):
    """A published network; its width, `width_argument`, is the outputs of `first_layer`.

    `left_out`: names, a regular expression, of weights in the checkpoint that it does not have.
    """

    network_class: type[nn.Module]
    options: dict
    rename_rules: tuple
    first_layer: str = "net.head"
    width_argument: str = "base_channels"
    left_out: str | None = None


NORMALISED, RAW = {"normalise": "nonzero"}, {"normalise": "none", "output": "clip"}
PIE_NET = PIENET, "events.conv", "base_channels"
NETWORKS = {
    "e2vid": PublishedNetwork(E2VIDPlus, NORMALISED | {"output": "sigmoid"}, UNET),
    "e2vid_plus": PublishedNetwork(E2VIDPlus, RAW, UNET),
    "firenet": PublishedNetwork(
        FireNet, NORMALISED | {"output": "none"}, FIRENET, "head", "channels"
    ),
    "firenet_plus": PublishedNetwork(FireNet, RAW, FIRENET_PLUS, "head", "channels"),
    "etnet": PublishedNetwork(ETNet, RAW | {"output": "sigmoid"}, ETNET),
    "hypere2vid": PublishedNetwork(HyperE2VID, RAW, HYPER),
    "cista": PublishedNetwork(
        CISTA, NORMALISED | {"output": "sigmoid"}, CISTA_TC, "events", "channels"
    ),
    "pienet": PublishedNetwork(PIENet, RAW, *PIE_NET),
    "pienet_lite": PublishedNetwork(
        PIENet, RAW | {"channels": (16, 24), "pools": (2, 2)}, *PIE_NET
    ),
    # What event-pienet 1.1.3 runs of the checkpoint of PIE-Net.
    "pienet_package": PublishedNetwork(
        PIENet, RAW | {"refine": False}, *PIE_NET, r"\.out\.mbconv_0\."
    ),
}


def load_pretrained(architecture: str, weights: str | None) -> nn.Module:
    """Return the network `architecture` with the weights that `baseline.weights` gives, frozen.

    `weights`: a name in weights/ or a path of ours (.safetensors, .ckpt), trained on clean events;
    or the path of the published checkpoint.  Raises ValueError, which says where to get them, when
    there are none, and when they are another network's.

    All were published with bins between the first and last event of a window; the simulator uses
    its edges.
    """
    network_class = _find_architecture(architecture).network_class
    path = files.locate(weights or "")
    if path.is_file() and path.suffix in OURS:
        network = files.load(path).requires_grad_(False)
        if type(network) is not network_class:  # HyperE2VID and ET-Net are kinds of E2VID+
            got = f"a {type(network).__name__} is in {weights}"
            raise ValueError(f"baseline.weights are not those of {architecture}: {got}")
        return network
    if path.is_file():
        return load_published(architecture, path)
    command = f"`{COMMAND}train experiment=clean/{architecture}`"
    make = f"make ours with {command}, " if path.parent.name == "clean" else ""
    raise ValueError(
        f"baseline.weights must be a file with the weights of {architecture}, got {weights}; {make}"
        "or give the path of its authors' checkpoint"
    )


def load_published(architecture: str, path: Path) -> nn.Module:
    """Return the published network `architecture`, a key of NETWORKS, frozen and in eval mode.

    Width and bins follow from the checkpoint at `path`.  Raises ValueError with the missing and
    extra names when the weights are another network's.
    """
    network_class, options, rules, first_layer, width, unused = _find_architecture(architecture)
    weights = read_pickled_tensors(path)
    weights = {k: v for k, v in weights.items() if not (unused and re.search(unused, k))}
    head, sizes = weights.get(published_name(f"{first_layer}.weight", rules)), {}
    if head is not None and head.dim() == 4 and head.numel() > 0:
        sizes = {"bins": head.shape[1], width: head.shape[0]}
    with torch.device("meta"):  # without memory: a small file may ask for a huge network
        own = network_class(**sizes, **options).state_dict()
    names = {ours: published_name(ours, rules) for ours in own}
    wanted = {names[ours]: value for ours, value in own.items()}
    files.check_weights_fit(f"baseline.weights are not those of {architecture}", wanted, weights)
    network = network_class(**sizes, **options)
    network.load_state_dict({ours: weights[theirs] for ours, theirs in names.items()})
    return network.eval().requires_grad_(False)


def published_name(ours: str, rules: tuple[tuple[str, str], ...]) -> str:
    """Return the published name of a weight of ours."""
    for pattern, published in rules:
        ours = re.sub(pattern, published, ours)
    return ours


def _find_architecture(architecture: str) -> PublishedNetwork:
    if architecture not in NETWORKS:
        names = ", ".join(NETWORKS)
        raise ValueError(f"baseline.architecture must be one of {names}, got {architecture}")
    return NETWORKS[architecture]
