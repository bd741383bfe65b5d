"""Turbulence as an operator: clean frames in, what every view sees out; tilt first, then blur."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import product

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import layout, view_id
from src.sim.turbulence import blur
from src.sim.turbulence.atmosphere import ALPHA_FPS, Atmosphere
from src.sim.turbulence.fidelity import Fidelity, choose, mean_psf
from src.sim.turbulence.halo import Halo
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.model import Crop
from src.sim.turbulence.p2s import Spots, band_for
from src.sim.turbulence.phase import Waves, draw_waves, evolve, flow, look_from
from src.sim.turbulence.psf import fraunhofer_psf
from src.sim.turbulence.ranges import require
from src.sim.turbulence.threads import in_threads
from src.sim.turbulence.wave_field import Field

TEMPORAL = ("ar1", "flow", "mixed")
OWN_WIND = 0.5  # rms of a layer's own wind over the wind that all layers share
WAVES = 384
TILE = 320  # pixels; larger pictures are made tile by tile, to bound the memory
CHUNK = 2_000_000  # numbers at the nodes of a view at a time


class Turbulence:
    """The atmosphere between a scene and the views of a light field.

    `views`: how many (see `optics.layout`) or a list of (row, col); frames are `height` x `width`
    pixels at `fps`.  `tolerance` in (0, 1]: the error allowed, as a share of the power by which the
    turbulence blurs a picture at random (fidelity.py).  `modes`: how many Noll modes from
    tilt on, 2 to 200, no more than a fitted network knows; None: as the tolerance asks.  `psf`:
    `fitted` (basis and network) or `exact` (Fraunhofer at every node).  `temporal`: `ar1` (the
    paper: alpha per frame at 120 fps), `flow`, frozen turbulence in `wind_layers` layers each
    carried by a wind of its own, about `wind_m_s` (None: the atmosphere's), or `mixed`, one of the
    two drawn per clip.
    `views_correlation`: `independent` (the paper) or `baseline`, sub-apertures `baseline_m` apart
    (None: touching) looking through the same air.  `atmosphere` None is the identity.
    Raises ValueError for values outside their range.
    """

    def __init__(
        self,
        atmosphere: Atmosphere | None,
        *,
        views: int | Sequence[Sequence[int]],
        height: int,
        width: int,
        fps: float = 120.0,
        tolerance: float = 0.26,
        modes: int | None = None,
        psf: str = "fitted",
        temporal: str = "ar1",
        wind_m_s: float | None = None,
        wind_layers: int = 4,
        views_correlation: str = "independent",
        baseline_m: float | None = None,
    ):
        require(height >= 1 and width >= 1, "frame", "at least 1 x 1", (height, width))
        require(0 < fps < math.inf, "fps", "> 0", fps)
        require(0 < tolerance <= 1, "tolerance", "in (0, 1]", tolerance)
        require(psf in ("fitted", "exact"), "psf", "fitted or exact", psf)
        require(temporal in TEMPORAL, "temporal", "ar1, flow or mixed", temporal)
        valid = wind_m_s is None or 0 <= wind_m_s < math.inf
        require(valid, "wind_m_s", ">= 0 or null", wind_m_s)
        require(1 <= wind_layers <= 100, "wind_layers", "in [1, 100]", wind_layers)
        shared = views_correlation == "baseline"
        valid = shared or views_correlation == "independent"
        require(valid, "views_correlation", "independent or baseline", views_correlation)
        valid = baseline_m is None or 0 <= baseline_m < math.inf
        require(valid, "baseline_m", ">= 0", baseline_m)
        self.atmosphere, self.height, self.width, self.fps = atmosphere, height, width, fps
        self.positions = layout(views) if isinstance(views, int) else tuple(map(tuple, views))
        self.temporal, self.wind_layers, self.wind_m_s = temporal, wind_layers, wind_m_s
        self.shared, self.baseline_m = shared, baseline_m
        self.clear = atmosphere is None or atmosphere.d_over_r0 == 0
        self.fidelity, self.spots, self.halo = Fidelity(), None, None
        if not self.clear:
            chosen = choose(atmosphere, width, tolerance, psf == "exact", modes)
            strength, airy, kernel = chosen.blurring_d_over_r0, chosen.airy_px, chosen.kernel
            if chosen.rank:
                numbers = chosen.network, chosen.rank, airy, kernel
                self.spots = Spots(band_for(strength), *numbers, strength)
            self.fidelity, self.halo = chosen, Halo(mean_psf(strength), airy, kernel)

    @property
    def facts(self) -> dict[str, float | int | str]:
        """What is recorded about the clip: its `fidelity`."""
        return asdict(self.fidelity)

    @torch.no_grad()
    def degrade(
        self,
        frames: Float[Tensor, "n frames h w"],
        generator: torch.Generator,
        *,
        crop: Crop | None = None,
    ) -> Float[Tensor, "n views frames hc wc"]:
        """Return what every view sees, linear light in and out.

        Only `crop` (top, left, height, width) is simulated; it equals that part of the whole.
        """
        window = self._window(frames, crop)
        if self.clear:
            top, left, height, width = window
            part = frames[:, None, :, top : top + height, left : left + width]
            return part.expand(-1, len(self.positions), -1, -1, -1)
        size = (len(frames), len(self.positions), frames.shape[1], *window[2:])
        out = frames.new_empty(size, dtype=torch.float32)
        for index, clip in enumerate(frames.float()):
            waves, moving = self._draw(generator, len(clip))
            moving = moving.to(clip.device)
            for tile in _tiles(window):
                y, x = tile[0] - window[0], tile[1] - window[1]
                part = out[index, ..., y : y + tile[2], x : x + tile[3]]
                self._clip(clip, waves, moving, tile, part)
        return out

    @torch.no_grad()
    def tilt(
        self, frames: int, generator: torch.Generator, *, crop: Crop | None = None
    ) -> Float[Tensor, "views frames 2 h w"]:
        """Return the displacement (x, y) in pixels that `degrade` gives its first clip.

        For a generator in the same state, and that many frames.
        """
        window = crop or (0, 0, self.height, self.width)
        if self.clear:
            return torch.zeros(len(self.positions), frames, 2, *window[2:])
        waves, moving = self._draw(generator, frames)
        field = self._field(waves, slice(0, 2), window, moving.device)
        return self._tilt_px * torch.stack([field.at_pixels(c).transpose(0, 1) for c in moving])

    def _clip(self, frames: Tensor, waves: Waves, moving: Tensor, tile: Crop, out: Tensor) -> None:
        """Write what every view sees in `tile` to `out` (views, frames, h, w).

        A view's phase is computed apart, so that its numbers do not depend on its company.
        """
        reach, device = self.fidelity.kernel // 2, frames.device
        top, left, height, width = tile
        halo = self.halo(frames, *tile)
        window = (top - reach, left - reach, height + 2 * reach, width + 2 * reach)
        tilt = self._field(waves, slice(0, 2), window, device)
        rest = self._field(waves, slice(2, None), window, device)
        lattices = self._lattices(window, self.fidelity.pitch, 1)
        lines = self.fidelity.rank or self.fidelity.kernel**2
        numbers = max(2, lines) * (height + 2 * reach) * (width + 2 * reach)
        step = max(1, CHUNK // numbers)

        def one(view: int, first: int) -> None:
            part = slice(first, first + step)
            amplitudes = moving[view, part]
            moved = self._tilt_px * tilt.at_pixels(amplitudes)
            nodes = self._nodes(rest.at_nodes(amplitudes))
            around = (self.fidelity.kernel, self.spots, *lattices, halo[part], self.halo.share)
            out[view, part] = blur.degrade(frames[part], moved, nodes, *around)

        in_threads(one, product(range(len(moving)), range(0, len(frames), step)), device)

    def _nodes(
        self, phase: Float[Tensor, "blurmodes frames rows columns"]
    ) -> Float[Tensor, "numbers frames rows columns"]:
        """Return what the PSFs are at the nodes: weights of the basis, or their very pixels."""
        if self.spots is not None:
            return self.spots(phase)
        flat = torch.nn.functional.pad(phase.permute(1, 2, 3, 0), (2, 0))
        size, airy = self.fidelity.kernel, self.fidelity.airy_px
        psf = fraunhofer_psf(flat, airy_px=airy, size=size, whole=True)
        return psf.flatten(3).permute(3, 0, 1, 2).contiguous()

    def _field(self, waves: Waves, modes: slice, window: Crop, device: torch.device) -> Field:
        """Prepare tilt (modes 0, 1) or the modes that blur on the lattice meant for them."""
        is_tilt = modes.start == 0
        pitch = self.fidelity.tilt_pitch if is_tilt else self.fidelity.pitch
        lattices = self._lattices(window, pitch, 3 if is_tilt else 1)
        return Field(waves, modes, *lattices, (self.height, self.width), device)

    @property
    def _tilt_px(self) -> float:
        """Pixels a radian of Noll's a2: (2 / pi) lambda f / (D p)."""
        return 2 / math.pi * self.fidelity.airy_px

    def _draw(
        self, generator: torch.Generator, frames: int
    ) -> tuple[Waves, Complex[Tensor, "views frames waves"]]:
        """Draw one clip's waves, and their amplitudes in every view and frame."""
        key = noise.base_key(generator)
        waves = draw_waves(
            self.atmosphere,
            noise.key(key, "waves"),
            modes=self.fidelity.modes,
            waves=WAVES,
            width_px=self.width,
        )
        return waves, self._amplitudes(key, waves, frames).to(torch.complex64)

    def _amplitudes(
        self, key: int, waves: Waves, frames: int
    ) -> Complex[Tensor, "views frames waves"]:
        """Every view counts from its own id, or all from 0 where they share the air."""
        ids = [0 if self.shared else view_id(position) for position in self.positions]
        flows = self._flows(key)
        drawn = 1 if flows else frames
        counters = torch.arange(drawn * 2 * len(waves.place)).reshape(drawn, -1, 2)
        counters = counters + (torch.tensor(ids) << 40)[:, None, None, None]
        fresh = noise.normal(noise.key(key, "phase"), counters).double()
        if flows:
            c = flow(waves, fresh, self._winds(key), torch.arange(frames).double() / self.fps)
        else:
            c = evolve(fresh, self.atmosphere.alpha ** (ALPHA_FPS / self.fps))
        if self.shared:
            pitch = self.atmosphere.aperture_m if self.baseline_m is None else self.baseline_m
            away = torch.tensor(self.positions, dtype=torch.float64).flip(-1) * pitch
            c = c * look_from(waves, away)[:, None]
        return c

    def _flows(self, key: int) -> bool:
        """Return whether the wind carries the turbulence of this clip."""
        if self.temporal != "mixed":
            return self.temporal == "flow"
        return float(noise.uniform(noise.key(key, "temporal"), torch.tensor(0))) < 0.5

    def _winds(self, key: int) -> Float[Tensor, "layers 2"]:
        """Return the wind (x, y) of each layer in m/s: a common one, half as much of its own.

        The mean square is that of `wind_m_s`; a single layer has that very speed.
        """
        speed = self.atmosphere.wind_m_s if self.wind_m_s is None else self.wind_m_s
        turn = 2 * math.pi * float(noise.uniform(noise.key(key, "wind"), torch.tensor(0)))
        common = torch.tensor([math.cos(turn), math.sin(turn)], dtype=torch.float64)
        if self.wind_layers == 1:
            return speed * common[None]
        counters = torch.arange(2 * self.wind_layers).reshape(-1, 2)
        own = noise.normal(noise.key(key, "winds"), counters).double() * OWN_WIND / math.sqrt(2)
        return speed / math.sqrt(1 + OWN_WIND**2) * (common + own)

    def _lattices(self, window: Crop, pitch: int, order: int) -> tuple[Lattice, Lattice]:
        top, left, height, width = window
        return Lattice(top, height, pitch, order), Lattice(left, width, pitch, order)

    def _window(self, frames: Tensor, crop: Crop | None) -> Crop:
        size = (self.height, self.width)
        require(tuple(frames.shape[-2:]) == size, "frame", f"{size}", tuple(frames.shape[-2:]))
        top, left, height, width = crop or (0, 0, *size)
        inside = 0 <= top <= top + height <= size[0] and 0 <= left <= left + width <= size[1]
        require(inside and height > 0 and width > 0, "crop", f"inside the {size} frame", crop)
        return top, left, height, width


def _tiles(window: Crop) -> Iterator[Crop]:
    top, left, height, width = window
    for y in range(0, height, TILE):
        for x in range(0, width, TILE):
            yield top + y, left + x, min(TILE, height - y), min(TILE, width - x)
