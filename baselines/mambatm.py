"""MambaTM (Zhang et al., CVPR 2025): video through turbulence to video without, frames in and out.

An encoder at 1, 1/2, 1/4, 1/8 of each frame; at 1/8, groups of three layers of selective state
spaces over all tokens of a window - rows first, time first, along a Hilbert curve; a decoder for
the latent phase distortion (two of tilt, mean and log-variance of a blur latent); one more group
guided by it; a decoder for the picture.

Differs from the published code: backward scans are turned back also in guided layers, the
convolution of local layers runs on the raster, frames need not be square, fusions are weighed
through GELU, the last decoder draws what is added to the input, `stabilise_input` gives it frames
held still (off in the published size), and no loss here supervises the latent phase distortion.
"""

from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from baselines.hilbert import hilbert_order
from baselines.selective_scan import BidirectionalMamba
from baselines.stabilise import backward_warp_video, estimate_jitter
from src.models.layers import pad_centred_to_multiple
from src.models.network import FramePostprocessor

DISTORTION = 4  # channels: tilt down and right, mean and log-variance of the blur latent
SCALES = 3
Tokens = Float[Tensor, "n cells c"]
Grid = tuple[int, int, int]  # frames, height, width
PIXELS = 2**20  # encoded or decoded at once where no gradient is asked for: 16 frames of 256 x 256


class MambaTM(FramePostprocessor):
    """`frame_channels`: 1 (grey) or 3.  `base_channels`: of the encoder, >= 8, 8 times as many in
    the trunk.  `scan_blocks`: >= 2, of three layers, the last one guided.  Published: 3, 16, 6, 16
    `states`.  `stabilise_input`: the encoder also sees the frames without their jitter
    (baselines/stabilise.py), of which the tilt channels take out nothing to twice as much; all of
    it before any training.
    """

    def __init__(
        self,
        frame_channels: int = 1,
        base_channels: int = 8,
        scan_blocks: int = 2,
        states: int = 8,
        stabilise_input: bool = False,
    ):
        super().__init__()
        for name, value, least in (
            ("scan_blocks", scan_blocks, 2),
            ("base_channels", base_channels, 8),
        ):
            if value < least:
                raise ValueError(f"postprocess.{name} must be >= {least}, got {value}")
        width = base_channels * 2**SCALES
        self.frame_channels, self.stabilise_input = frame_channels, stabilise_input
        self.encoder = FrameEncoder((1 + stabilise_input) * frame_channels, base_channels)
        self.distortion_encoder = FrameEncoder(DISTORTION, base_channels)
        self.distortion_width = nn.Conv2d(width, width, 1)
        self.distortion_decoder = RestorationDecoder(DISTORTION, base_channels)
        self.decoder = RestorationDecoder(frame_channels, base_channels)
        for parameter in self.decoder.out[-1].parameters():
            nn.init.zeros_(parameter)  # what is added to the input begins with nothing
        if stabilise_input:
            for parameter in self.distortion_decoder.out[-1].parameters():
                nn.init.zeros_(parameter[:2])  # and takes out the jitter that was found
        free = range(3 * (scan_blocks - 1))
        self.free = nn.ModuleList(MambaLayer(width, states, takes_guide=False) for _ in free)
        self.guided = nn.ModuleList(MambaLayer(width, states, takes_guide=True) for _ in range(3))

    def forward(
        self, frames: Float[Tensor, "n frames c h w"]
    ) -> tuple[Float[Tensor, "n frames c h w"], Float[Tensor, "n frames 4 h w"]]:
        """Return the frames without turbulence, not clipped, and the latent phase distortion.

        Grey frames may be given to a network of three channels too.
        """
        n, count, given, height, width = frames.shape
        frames = frames.expand(-1, -1, self.frame_channels, -1, -1)
        shift = estimate_jitter(frames) if self.stabilise_input else None
        seen = (
            frames if shift is None else torch.cat([frames, backward_warp_video(frames, shift)], 2)
        )
        flat, (top, left) = pad_centred_to_multiple(seen.flatten(0, 1), 2**SCALES)
        whole = torch.is_grad_enabled()
        limit = len(flat) if whole else max(1, PIXELS // flat[0, 0].numel())
        maps = zip(*map(self.encoder, flat.split(limit)), strict=True)
        *skips, deep = [torch.cat(scale) for scale in maps]
        grid = (count, *deep.shape[-2:])
        orders = [order.to(frames.device) for order in row_time_hilbert_orders(*grid)]
        tokens = _tokens(deep, count)
        for i, layer in enumerate(self.free):
            tokens = layer(tokens, grid, orders[i % 3])
        latent = self.distortion_width(_maps(tokens, grid))
        distortion = _decode(self.distortion_decoder, latent, skips, limit)
        guides = [self.distortion_encoder(part)[-1] for part in distortion.split(limit)]
        guide = _tokens(torch.cat(guides), count)
        for i, layer in enumerate(self.guided):
            tokens = layer(tokens, grid, orders[i], guide)
        added = _decode(self.decoder, _maps(tokens, grid), skips, limit)
        added, distortion = (
            part[..., top : top + height, left : left + width].unflatten(0, (n, count))
            for part in (added, distortion)
        )
        if shift is not None:
            frames = backward_warp_video(frames, 2 * distortion[:, :, :2].sigmoid() * shift)
        clean = frames + added
        return (clean.mean(2, keepdim=True) if given == 1 else clean), distortion


def row_time_hilbert_orders(frames: int, height: int, width: int) -> list[Int[Tensor, " cells"]]:
    """Return the flat indices of a (frames, height, width) box row by row, column of time by
    column of time, and along a Hilbert curve.
    """
    raster = torch.arange(frames * height * width)
    in_time = raster.view(frames, height, width).permute(2, 1, 0).flatten()
    return [raster, in_time, hilbert_order(frames, height, width)]


class MambaLayer(nn.Module):
    """A selective state space along an order of the tokens, then a perceptron with a depthwise
    3x3x3 convolution inside; both normalised before and added.
    """

    def __init__(self, width: int, states: int, takes_guide: bool):
        super().__init__()
        self.norm, self.mixer = nn.LayerNorm(width), BidirectionalMamba(width, states, takes_guide)
        if takes_guide:
            self.guide_norm = nn.LayerNorm(width)
        self.mlp_norm = nn.LayerNorm(width)
        self.wide, self.back = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.near = nn.Conv3d(4 * width, 4 * width, 3, padding=1, groups=4 * width)

    def forward(
        self, tokens: Tokens, grid: Grid, order: Int[Tensor, " cells"], guide: Tokens | None = None
    ) -> Tokens:
        """Return tokens of the same shape; `grid` is (frames, h, w), row-major as the tokens."""
        guide = None if guide is None else self.guide_norm(guide)[:, order]
        mixed = self.mixer(self.norm(tokens)[:, order], guide)
        tokens = tokens + torch.empty_like(mixed).index_copy(1, order, mixed)
        hidden = self.wide(self.mlp_norm(tokens)).transpose(1, 2).unflatten(2, grid)
        hidden = functional.gelu(self.near(hidden)).flatten(2).transpose(1, 2)
        return tokens + self.back(hidden)


class FrameEncoder(nn.Module):
    """Maps of a frame at 1, 1/2, 1/4 and 1/8, each through a residual dense block."""

    def __init__(self, channels: int, features: int):
        super().__init__()
        widths = [channels, *(features * 2**scale for scale in range(SCALES + 1))]
        growths = [features, features * 3 // 2, 2 * features, 2 * features]
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, 5, stride=2 if scale else 1, padding=2)
            for scale, (a, b) in enumerate(pairwise(widths))
        )
        self.dense = nn.ModuleList(map(DenseBlock, widths[1:], growths))

    def forward(self, x: Float[Tensor, "n c h w"]) -> list[Tensor]:
        maps = []
        for down, dense in zip(self.down, self.dense, strict=True):
            x = dense(down(x))
            maps.append(x)
        return maps


class DenseBlock(nn.Module):
    """Three convolutions that each see all before them, brought back to size and added."""

    def __init__(self, width: int, growth: int):
        super().__init__()
        self.convs = nn.ModuleList(
            nn.Conv2d(width + i * growth, growth, 3, padding=1) for i in range(3)
        )
        self.back = nn.Conv2d(width + 3 * growth, width, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        seen = x
        for conv in self.convs:
            seen = torch.cat([seen, conv(seen).relu()], 1)
        return x + self.back(seen)


class RestorationDecoder(nn.Module):
    """From 1/8 back to full resolution, fused at each scale with what the encoder saw."""

    def __init__(self, channels: int, features: int):
        super().__init__()
        widths = [features * 2**scale for scale in reversed(range(SCALES))]
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(2 * width if scale == 0 else 4 * width, width, 3, 2, 1, 1)
            for scale, width in enumerate(widths)
        )
        self.fuse = nn.ModuleList(ChannelAttentionBlock(2 * width) for width in widths)
        self.out = nn.Sequential(
            nn.Conv2d(2 * features, features, 3, padding=1),
            nn.Conv2d(features, channels, 3, padding=1),
        )

    def forward(
        self, x: Float[Tensor, "n c h w"], skips: list[Tensor]
    ) -> Float[Tensor, "n c2 h8 w8"]:
        """Return the picture at eight times the resolution; `skips` are finest first."""
        for up, fuse, skip in zip(self.up, self.fuse, reversed(skips), strict=True):
            x = fuse(torch.cat([up(x), skip], 1))
        return self.out(x)


class ChannelAttentionBlock(nn.Module):
    """Two convolutions whose outcome is weighed channel by channel and added."""

    def __init__(self, width: int):
        super().__init__()
        self.inside = nn.Conv2d(width, width, 1)
        self.around = nn.Conv2d(width, width, 3, padding=1)
        self.squeeze = nn.Conv2d(width, width // 16, 1, bias=False)
        self.weigh = nn.Conv2d(width // 16, width, 1, bias=False)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        outcome = self.around(functional.gelu(self.inside(x)))
        mean = self.squeeze(outcome.mean((-2, -1), keepdim=True))
        weights = self.weigh(functional.gelu(mean)).sigmoid()
        return x + weights * outcome


def _decode(decoder: RestorationDecoder, deep: Tensor, skips: list[Tensor], limit: int) -> Tensor:
    parts = zip(*(maps.split(limit) for maps in (deep, *skips)), strict=True)
    return torch.cat([decoder(x, seen) for x, *seen in parts])


def _tokens(maps: Tensor, frames: int) -> Tensor:
    return maps.unflatten(0, (-1, frames)).movedim(2, -1).flatten(1, 3)


def _maps(tokens: Tensor, grid: Grid) -> Tensor:
    return tokens.unflatten(1, grid).movedim(-1, 2).flatten(0, 1)
