"""What a SetNet draws, in bytes, which OpenVINO computes at two to four times the speed of bf16 or
float32."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.models.fast import computes_bytes
from src.models.setnet import SetNet

LARGEST = 8.0  # of a map; what is larger is cut (docs/decisions/0033-nine-views-in-3-4-ms.md)
WEIGHT, MAP = 127, 255  # steps from zero to the largest
WORTH = 16  # channels from which on it is faster, or no slower


def drawn_in_bytes(network: nn.Module) -> None:
    """Let the larger one of the convolutions with which a SetNet draws compute in bytes, where that
    is faster: a pixel moves by less than bf16 moves it.
    """
    if isinstance(network, SetNet) and network.half >= WORTH and computes_bytes():
        network.mix2 = EightBits(network.mix2)


class EightBits(nn.Module):
    """`conv` for maps from zero to LARGEST: they and the weights, output by output, are rounded to
    bytes (Jacob et al. 2018, arXiv:1712.05877).  Padding of `conv` repeats the border, as SetNet's.
    """

    def __init__(self, conv: nn.Conv2d):
        super().__init__()
        self.weight, self.bias = (part.detach().float() for part in (conv.weight, conv.bias))
        self.step = self.weight.abs().amax((1, 2, 3)).clamp_min(1e-12) / WEIGHT
        self.zeros = torch.zeros(len(self.step), dtype=torch.int32)
        self.padding = conv.padding[0]

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n o _h _w"]:
        """Return the convolution, in the type of `x`."""
        weight = torch.fake_quantize_per_channel_affine(
            self.weight, self.step, self.zeros, 0, -WEIGHT, WEIGHT
        )
        seen = torch.fake_quantize_per_tensor_affine(x.float(), LARGEST / MAP, 0, 0, MAP)
        seen = functional.pad(seen, (self.padding,) * 4, mode="replicate")
        return functional.conv2d(seen, weight, self.bias).to(x.dtype)
