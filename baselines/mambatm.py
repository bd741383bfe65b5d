"""MambaTM (Zhang et al., CVPR 2025): video through turbulence to video without, frames in and out.

An encoder at 1, 1/2, 1/4, 1/8 of each frame; at 1/8, groups of three layers of selective state
spaces over all tokens of a window - rows first, time first, along a Hilbert curve; a decoder for
the latent phase distortion (two of tilt, mean and log-variance of a blur latent); one more group
guided by it; a decoder for the picture.

Differs from the published code where that is at odds with its paper: backward scans are turned
back also in guided layers, the convolution of local layers runs on the raster and not on the curve,
frames need not be square, the few channels that weigh a fusion are GELU, which cannot die, not
ReLU, and the last decoder draws what is added to the input, so that a short training starts there.
With `steadied` the input is held still first, and the two latents of tilt say by how much.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from baselines.hilbert import hilbert_order
from baselines.selective_scan import Mixer
from baselines.stabilise import jitter, pull
from src.models.layers import pad_to_multiple

DISTORTION = 4  # channels: tilt down and right, mean and log-variance of the blur latent
SCALES = 3
PIXELS = 2**20  # encoded or decoded at once where no gradient is asked for: 16 frames of 256 x 256


class MambaTM(nn.Module):
    """`channels`: of a frame, 1 (grey) or 3.  `features`: of the encoder, 8 times as many in the
    trunk.  `groups`: of three layers, the last one guided.  Published: 3, 16, 6 and 16 `states`.
    `steadied`: the encoder also sees the frames without their jitter (baselines/stabilise.py), of
    which the tilt channels take out nothing to twice as much; all of it before any training.
    """

    views = None  # it sees none
    WINDOW, OVERLAP = 16, 4  # frames that are restored at a time; of them, shared with the next

    def __init__(
        self,
        channels: int = 1,
        features: int = 8,
        groups: int = 2,
        states: int = 8,
        steadied: bool = False,
    ):
        super().__init__()
        if groups < 2:
            raise ValueError(f"postprocess.groups must be >= 2, got {groups}")
        if features < 8:
            raise ValueError(f"postprocess.features must be >= 8, got {features}")
        width = features * 2**SCALES
        self.channels, self.steadied = channels, steadied
        self.encoder = Encoder(2 * channels if steadied else channels, features)
        self.distortion_encoder = Encoder(DISTORTION, features)
        self.distortion_width = nn.Conv2d(width, width, 1)
        self.distortion_decoder = Decoder(DISTORTION, features)
        self.decoder = Decoder(channels, features)
        for parameter in self.decoder.out[-1].parameters():
            nn.init.zeros_(parameter)  # what is added to the input begins with nothing
        if steadied:
            for parameter in self.distortion_decoder.out[-1].parameters():
                nn.init.zeros_(parameter[:2])  # and takes out the jitter that was found
        free = range(3 * (groups - 1))
        self.free = nn.ModuleList(Layer(width, states, guided=False) for _ in free)
        self.guided = nn.ModuleList(Layer(width, states, guided=True) for _ in range(3))

    def forward(
        self, frames: Float[Tensor, "n frames c h w"]
    ) -> tuple[Float[Tensor, "n frames c h w"], Float[Tensor, "n frames 4 h w"]]:
        """Return the frames without turbulence, not clipped, and the latent phase distortion.

        Grey frames may be given to a network of three channels too.
        """
        n, count, given, height, width = frames.shape
        frames = frames.expand(-1, -1, self.channels, -1, -1)
        shift = jitter(frames) if self.steadied else None
        seen = frames if shift is None else torch.cat([frames, pull(frames, shift)], 2)
        flat, (top, left) = pad_to_multiple(seen.flatten(0, 1), 2**SCALES)
        parts = parts_of(flat)
        maps = zip(*(self.encoder(flat[part]) for part in parts), strict=True)
        *skips, deep = [torch.cat(scale) for scale in maps]
        grid = (count, *deep.shape[-2:])
        orders = [order.to(frames.device) for order in scan_orders(*grid)]
        tokens = deep.unflatten(0, (n, count)).movedim(2, -1).flatten(1, 3)
        for i, layer in enumerate(self.free):
            tokens = layer(tokens, grid, orders[i % 3])
        latent = self.distortion_width(_maps(tokens, grid))
        distortion = _decode(self.distortion_decoder, latent, skips, parts)
        guide = torch.cat([self.distortion_encoder(distortion[part])[-1] for part in parts])
        guide = guide.unflatten(0, (n, count)).movedim(2, -1).flatten(1, 3)
        for i, layer in enumerate(self.guided):
            tokens = layer(tokens, grid, orders[i], guide)
        added = _decode(self.decoder, _maps(tokens, grid), skips, parts)
        added, distortion = (
            part[..., top : top + height, left : left + width].unflatten(0, (n, count))
            for part in (added, distortion)
        )
        if shift is not None:
            frames = pull(frames, 2 * distortion[:, :, :2].sigmoid() * shift)
        clean = frames + added
        return (clean.mean(2, keepdim=True) if given == 1 else clean), distortion

    @torch.no_grad()
    def restore(
        self,
        frames: Float[Tensor, "n frames c h w"],
        *,
        window: int = WINDOW,
        overlap: int = OVERLAP,
    ) -> Float[Tensor, "n frames c h w"]:
        """Return a video of any length without turbulence, in [0, 1], window by window.

        Of two windows that overlap each gives the half that lies deeper in it.  Raises ValueError
        unless 0 <= overlap < window.
        """
        if not 0 <= overlap < window:
            raise ValueError(f"postprocess.overlap must be in [0, {window}), got {overlap}")
        count, parts, done = frames.shape[1], [], 0
        for start in window_starts(count, window, overlap):
            stop = min(start + window, count)
            until = count if stop == count else stop - overlap // 2
            clean, _ = self(frames[:, start:stop])
            parts.append(clean[:, done - start : until - start])
            done = until
        return torch.cat(parts, 1).clamp(0, 1)


def parts_of(frames: Float[Tensor, "n c h w"]) -> list[slice]:
    """Return the slices of the frames that are encoded and decoded at once.

    All of them for training; else as many as bound the memory.
    """
    count = len(frames)
    if not torch.is_grad_enabled():
        count = max(1, PIXELS // (frames.shape[-2] * frames.shape[-1]))
    return [slice(start, start + count) for start in range(0, len(frames), count)]


def window_starts(frames: int, window: int, overlap: int) -> list[int]:
    """Return where windows begin that cover `frames`; the last one ends with the video."""
    last = max(frames - window, 0)
    return [*range(0, last, window - overlap), last]


def scan_orders(frames: int, height: int, width: int) -> list[Int[Tensor, " cells"]]:
    """Return the flat indices of a (frames, height, width) box row by row, column of time by
    column of time, and along a Hilbert curve.
    """
    raster = torch.arange(frames * height * width)
    in_time = raster.view(frames, height, width).permute(2, 1, 0).flatten()
    return [raster, in_time, hilbert_order(frames, height, width)]


class Layer(nn.Module):
    """A selective state space along an order of the tokens, then a perceptron with a depthwise
    3x3x3 convolution inside; both normalised before and added.
    """

    def __init__(self, width: int, states: int, guided: bool):
        super().__init__()
        self.norm, self.mixer = nn.LayerNorm(width), Mixer(width, states, guided)
        if guided:
            self.guide_norm = nn.LayerNorm(width)
        self.mlp_norm = nn.LayerNorm(width)
        self.wide, self.back = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.near = nn.Conv3d(4 * width, 4 * width, 3, padding=1, groups=4 * width)

    def forward(
        self,
        tokens: Float[Tensor, "n cells c"],
        grid: tuple[int, int, int],
        order: Int[Tensor, " cells"],
        guide: Float[Tensor, "n cells c"] | None = None,
    ) -> Float[Tensor, "n cells c"]:
        """Return tokens of the same shape; `grid` is (frames, h, w), row-major as the tokens."""
        guide = None if guide is None else self.guide_norm(guide)[:, order]
        mixed = self.mixer(self.norm(tokens)[:, order], guide)
        tokens = tokens + torch.empty_like(mixed).index_copy(1, order, mixed)
        hidden = self.wide(self.mlp_norm(tokens)).transpose(1, 2).unflatten(2, grid)
        hidden = functional.gelu(self.near(hidden)).flatten(2).transpose(1, 2)
        return tokens + self.back(hidden)


class Encoder(nn.Module):
    """Maps of a frame at 1, 1/2, 1/4 and 1/8, each through a residual dense block."""

    def __init__(self, channels: int, features: int):
        super().__init__()
        widths = [features * 2**scale for scale in range(SCALES + 1)]
        growths = [features, features * 3 // 2, 2 * features, 2 * features]
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, 5, stride=2 if scale else 1, padding=2)
            for scale, (a, b) in enumerate(zip([channels, *widths], widths, strict=False))
        )
        self.dense = nn.ModuleList(
            DenseBlock(width, growth) for width, growth in zip(widths, growths, strict=True)
        )

    def forward(self, x: Float[Tensor, "n c h w"]) -> list[Tensor]:
        """Return the maps, finest first."""
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
        """Return a map of the same shape."""
        seen = x
        for conv in self.convs:
            seen = torch.cat([seen, conv(seen).relu()], 1)
        return x + self.back(seen)


class Decoder(nn.Module):
    """From 1/8 back to full resolution, fused at each scale with what the encoder saw."""

    def __init__(self, channels: int, features: int):
        super().__init__()
        widths = [features * 2**scale for scale in reversed(range(SCALES))]
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(2 * width if scale == 0 else 4 * width, width, 3, 2, 1, 1)
            for scale, width in enumerate(widths)
        )
        self.fuse = nn.ModuleList(Fusion(2 * width) for width in widths)
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


class Fusion(nn.Module):
    """Two convolutions whose outcome is weighed channel by channel and added."""

    def __init__(self, width: int):
        super().__init__()
        self.inside = nn.Conv2d(width, width, 1)
        self.around = nn.Conv2d(width, width, 3, padding=1)
        self.squeeze = nn.Conv2d(width, width // 16, 1, bias=False)
        self.weigh = nn.Conv2d(width // 16, width, 1, bias=False)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Return a map of the same shape."""
        outcome = self.around(functional.gelu(self.inside(x)))
        mean = self.squeeze(outcome.mean((-2, -1), keepdim=True))
        weights = self.weigh(functional.gelu(mean)).sigmoid()
        return x + weights * outcome


def _decode(decoder: "Decoder", deep: Tensor, skips: list[Tensor], parts: list[slice]) -> Tensor:
    return torch.cat([decoder(deep[part], [skip[part] for skip in skips]) for part in parts])


def _maps(tokens: Tensor, grid: tuple[int, int, int]) -> Tensor:
    return tokens.unflatten(1, grid).movedim(-1, 2).flatten(0, 1)
