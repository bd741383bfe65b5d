"""HyperE2VID (Ercan et al., TIP 2024): E2VID whose first decoder has another kernel at each pixel.

A small network sees the events and the previous frame and mixes, at each pixel, six 5x5 kernels
(atoms) out of twelve fixed Fourier-Bessel functions; the atoms filter each channel.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import jn_zeros, jv
from torch import Tensor, nn
from torch.nn import functional

from baselines.e2vid_plus import E2VIDPlus
from src.models.layers import require_bias

ATOMS, FUNCTIONS = 6, 6  # functions of each of the two reaches


class HyperE2VID(E2VIDPlus):
    """The centre view's voxel grids to frames; 10,149,881 parameters and 574 numbers in buffers.

    As published: normalise none, output clip.
    """

    def __init__(
        self, bins: int = 5, base_channels: int = 32, normalise: str = "none", output: str = "clip"
    ):
        super().__init__(bins, base_channels, normalise, output)
        self.net.decoders = self.net.decoders[1:]
        self.dynamic = DynamicDecoder(8 * base_channels, 4 * base_channels, bins + 1)

    def predict_before_activation(self, grid: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Return the frame and (state of E2VID, frame before output handling and cropping)."""
        before, previous = state or (None, torch.zeros_like(grid[:, :1]))
        head, skips, after = self.net.encode(self.net.first_layer(grid), before)
        x = self.net.resblocks(skips[-1]) + skips.pop()
        x = self.dynamic(x, torch.cat([grid, previous], 1))
        frame = self.net.decode_logits(x, head, skips)
        return frame, (after, frame.detach())

    def state_sizes(self, grid: Tensor) -> list[tuple[int, ...]]:
        return [*super().state_sizes(grid), (len(grid), 1, *grid.shape[2:])]


class DynamicDecoder(nn.Module):
    """Doubles the resolution and convolves with kernels that a context chooses pixel by pixel.

    The kernels are sums of fixed functions, so the functions filter first and the context weighs
    what comes out: the same numbers without ever unfolding 5x5 patches.
    """

    functions: Tensor

    def __init__(self, inputs: int, outputs: int, context: int):
        super().__init__()
        self.fuse = nn.Conv2d(context, 32, 3, padding=1)
        mixes = ATOMS * 2 * FUNCTIONS
        self.weigh = nn.Sequential(
            nn.Conv2d(32, 64, 3, padding=1),
            nn.BatchNorm2d(64),
            nn.Tanh(),
            nn.Conv2d(64, mixes, 3, padding=1),
            nn.BatchNorm2d(mixes),
            nn.Tanh(),
        )
        small, large = (fourier_bessel_functions(reach)[:FUNCTIONS] for reach in (1, 2))
        functions = torch.cat([functional.pad(small, (1, 1, 1, 1)), large])
        self.register_buffer("functions", functions.flatten(1))
        self.compose = nn.Conv2d(inputs * ATOMS, outputs, 1)
        nn.init.kaiming_normal_(self.compose.weight, mode="fan_out", nonlinearity="relu")
        nn.init.zeros_(require_bias(self.compose))

    def forward(
        self, x: Float[Tensor, "n c h w"], context: Float[Tensor, "n k h8 w8"]
    ) -> Float[Tensor, "n c2 h2 w2"]:
        """Return the map at twice the resolution of `x`; `context` has eight times that of `x`."""
        x = functional.interpolate(x, scale_factor=2, mode="bilinear")
        context = functional.interpolate(context, scale_factor=0.25, mode="bilinear")
        weights = self.weigh(self.fuse(context)).unflatten(1, (ATOMS, -1)).permute(0, 3, 4, 1, 2)
        atoms = weights @ self._filtered(x)
        mix = self.compose.weight.view(-1, x.shape[1], ATOMS).transpose(1, 2).flatten(1)
        return functional.linear(atoms.flatten(3), mix, self.compose.bias).movedim(3, 1).relu()

    def _filtered(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h w functions c"]:
        """Return each channel through each function; channels last, five times as fast on a CPU."""
        channels = x.shape[1]
        x = x.contiguous(memory_format=torch.channels_last)
        kernels = self.functions.view(-1, 1, 1, 5, 5).expand(-1, channels, 1, 5, 5)
        maps = [functional.conv2d(x, kernel, padding=2, groups=channels) for kernel in kernels]
        return torch.stack([part.movedim(1, 3) for part in maps], 3)


def fourier_bessel_functions(reach: int) -> Float[Tensor, "functions side side"]:
    """Return harmonics of the disc of radius reach + 1/2, sampled on 2 reach + 1 pixels a side.

    J_k(z r) times 1, cos(k a), sin(k a), in order of the zeros z of J_k, as far as the sampling
    resolves them; the mean square norm of all of them is one (Qiu et al., ICML 2018).
    """
    radius = reach + 0.5
    highest = math.pi * radius * (2.0 if reach == 1 else 1.5)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1] / radius
    r, angle = np.hypot(rows, columns), np.arctan2(columns, rows)
    zeros = {order: jn_zeros(order, 8) for order in range(16)}
    resolved = [(z, k) for k in zeros for z, after in pairwise(zeros[k]) if after <= highest]
    harmonics = []
    for zero, order in sorted(resolved):
        radial = jv(order, zero * r) / abs(jv(order + 1, zero)) * (r < 1)
        turns = [np.cos(order * angle), np.sin(order * angle)]
        harmonics += [radial * math.sqrt(2) * turn for turn in turns] if order else [radial]
    functions = np.stack(harmonics)
    functions /= np.sqrt((functions**2).sum((1, 2)).mean())
    return torch.from_numpy(functions).float()
