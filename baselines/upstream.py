"""Published checkpoints as networks of ours, and back: only names differ, by the rules below."""

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from baselines.e2vid_plus import E2VIDPlus
from baselines.firenet import FireNet
from baselines.pickles import read
from src.models.files import folded

# Ours -> published, first match wins.
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
NETWORKS = {
    "e2vid": (E2VIDPlus, {"normalise": "nonzero", "output": "sigmoid"}, UNET),
    "e2vid_plus": (E2VIDPlus, {"normalise": "none", "output": "clip"}, UNET),
    "firenet": (FireNet, {"normalise": "nonzero", "output": "none"}, FIRENET),
    "firenet_plus": (FireNet, {"normalise": "none", "output": "clip"}, FIRENET_PLUS),
}


def load(name: str, checkpoint: str | Path | Mapping[str, Tensor]) -> nn.Module:
    """Return the published network `name`, frozen and in eval mode.

    `checkpoint`: a path, or a state dict with the published names.  `name`: e2vid, e2vid_plus,
    firenet or firenet_plus.  Width and bins follow from the weights.  Raises ValueError with the
    missing and extra names when the weights are another network's.
    """
    if name not in NETWORKS:
        raise ValueError(f"baseline.name must be one of {', '.join(NETWORKS)}, got {name}")
    kind, how, rules = NETWORKS[name]
    weights = _state_dict(checkpoint)
    head = weights.get(_rename("net.head.weight" if rules is UNET else "head.weight", rules))
    sizes = {} if head is None else {"bins": head.shape[1], _width(kind): head.shape[0]}
    network = kind(**sizes, **how)
    names = {ours: _rename(ours, rules) for ours in network.state_dict()}
    _check(name, names, weights, network.state_dict())
    network.load_state_dict({ours: weights[theirs] for ours, theirs in names.items()})
    return network.eval().requires_grad_(False)


def from_config(name: str, weights: str) -> nn.Module:
    """Return `load` of the path under `baseline.weights`, the key by which users give it."""
    return load(name, weights)


def export(name: str, network: nn.Module) -> dict[str, Tensor]:
    """Return the weights of `network` under published names, spectral norm folded."""
    rules = NETWORKS[name][2]
    return {_rename(ours, rules): value for ours, value in folded(network).items()}


def widen(head: Tensor, views: int) -> Tensor:
    """Return a head kernel (out, bins, k, k) for `views` stacked views: tiled, divided by `views`.

    Equal views then give what one view gave.
    """
    return head.repeat(1, views, 1, 1) / views


def _width(kind: type) -> str:
    return "channels" if kind is FireNet else "base_channels"


def _rename(ours: str, rules: tuple) -> str:
    for pattern, published in rules:
        if re.match(pattern, ours):
            return re.sub(pattern, published, ours)
    return ours


def _state_dict(checkpoint: str | Path | Mapping) -> Mapping[str, Tensor]:
    content = checkpoint if isinstance(checkpoint, Mapping) else read(checkpoint)
    content = content.get("state_dict", content) if isinstance(content, Mapping) else {}
    weights = {k: v for k, v in content.items() if isinstance(v, torch.Tensor)}
    if not weights:
        raise ValueError("baseline.weights must hold a state dict, got no tensors")
    return weights


def _check(name: str, names: dict, weights: Mapping, own: Mapping) -> None:
    wanted = set(names.values())
    missing, extra = sorted(wanted - weights.keys()), sorted(weights.keys() - wanted)
    fits = [o for o, t in names.items() if t in weights and weights[t].shape != own[o].shape]
    if missing or extra or fits:
        raise ValueError(
            f"baseline.weights are not those of {name}: missing {missing}, extra {extra}, "
            f"of another shape {fits}"
        )
