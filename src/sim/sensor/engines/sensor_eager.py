"""The sensor in plain torch, for any device: the kernel's formula, all pixels of a frame at once.

Integers and single divisions are the kernel's, so that the events are the same bit for bit.
"""

import numpy as np
import torch
from torch import Tensor

from src.sim import noise
from src.sim.sensor.engines.job import (
    CLIP,
    DELETE,
    HOLD,
    HOT_KEY,
    MISMATCH_KEY,
    NORMALS,
    RESIDUAL_KEY,
    SHOT_KEY,
    Job,
)  # fmt: skip
from src.sim.sensor.limits import check_intensities
from src.sim.sensor.response import lookup

NEVER = 2.0  # a time after the interval


def voxels(job: Job, grids: Tensor) -> Tensor:
    """Add the events to `grids` (n, windows, views, bins, h, w); `job.state` moves on.

    Raises ValueError for frames that are not finite or outside [0, 1].
    """
    check_intensities(job.frames)
    pixels, edges = Pixels(job), torch.from_numpy(job.edges).to(grids.device)
    frames = job.frames.unbind(2)
    if job.fresh:
        pixels.start(frames[0].float())
    for i, frame in enumerate(frames[int(job.fresh) :]):
        bins = Bins(edges, i, job.substeps, grids[:, i // job.substeps])
        pixels.advance(frame.float(), job.state.frame + i, bins)
    return grids


class Bins:
    """Adds events of one interval to its window's grid (n, views, bins, h, w)."""

    def __init__(self, edges: Tensor, i: int, substeps: int, grid: Tensor):
        edges, window = edges[..., None, None, None], i // substeps * substeps
        self.start = edges[:, i] - edges[:, window]
        self.ticks = (edges[:, i + 1] - edges[:, i]).float()
        length = (edges[:, window + substeps] - edges[:, window]).float()
        self.scale = torch.full_like(length, grid.shape[2] - 1) / length
        self.grid = grid

    def add(self, fired: Tensor, u: Tensor, sign: Tensor) -> None:
        """Add the events of the pixels where `fired`, at fractions `u` of the interval."""
        ticks = (torch.ceil(u * self.ticks) - 1).clamp(min=0) + self.start
        tau = ticks * self.scale
        bins = self.grid.shape[2]
        b = tau.long().clamp(0, bins - 1)
        late = torch.round((tau - b) * 2.0**20) * 2.0**-20
        sign = torch.where(fired, sign, 0).float()
        self.grid.scatter_add_(2, b[:, :, None], (sign * (1 - late))[:, :, None])
        late = torch.where(b + 1 < bins, sign * late, 0.0)
        self.grid.scatter_add_(2, (b + 1).clamp(max=bins - 1)[:, :, None], late[:, :, None])


class Pixels:
    """All pixels of a batch; the attributes of `job.state` are replaced as time goes on.

    `clip` holds the fields of CLIP, (n, 1, 1, 1); `pixel` and what is drawn with it are
    (n, views or 1, h, w).
    """

    def __init__(self, job: Job):
        self.job, self.state = job, job.state
        device, (n, _, _, h, w) = job.frames.device, job.frames.shape
        numbers = torch.from_numpy(job.clips.view(np.int64).reshape(n, -1, 1, 1, 1)).to(device)
        clip = dict(zip(CLIP.names, numbers.unbind(1), strict=True))
        for name in ("wait", "residual"):
            clip[name] = clip[name].view(torch.float64)
        self.clip, self.wait = clip, clip["wait"].float()
        self.keys = torch.from_numpy(job.keys).to(device)[..., None, None].unbind(2)
        rows = clip["top"] + torch.arange(h, device=device)[:, None]
        self.pixel = rows * clip["full_width"] + clip["left"] + torch.arange(w, device=device)
        normals, key = torch.from_numpy(NORMALS).to(device), self.keys[MISMATCH_KEY]
        self.on, self.off = (
            _spread(clip[name], clip["spread"], normals, noise.bits(key, 2 * self.pixel + side))
            for side, name in enumerate(("on", "off"))
        )
        self.hot = noise.bits(self.keys[HOT_KEY], self.pixel) < clip["hot_share"]

    def start(self, frame: Tensor) -> None:
        """Set the memory to the first frame (n, views, h, w), off by the residual."""
        level, state = lookup(self.job.level, frame), self.state
        share = noise.uniform(self.keys[RESIDUAL_KEY], self.pixel)
        away = (2 * share - 1).double() * self.clip["residual"]
        off = (away * torch.where(away > 0, self.on, self.off)).int()
        state.level, state.source, state.reference = level, level.clone(), level - off
        state.dead = torch.zeros_like(frame)

    def advance(self, frame: Tensor, number: int, bins: Bins) -> None:
        """Take all pixels through interval `number`, which ends with `frame`."""
        state, job = self.state, self.job
        source, level = self._levels(frame)
        leak = self.on * self.clip["leak"]
        drift = ((leak * (number + 1)) >> 24) - ((leak * number) >> 24)
        l0, l1, ref = state.level.long(), level + drift, state.reference.long()
        u, sign = self._noise(frame, number)
        events = _v2e if job.v2e else _linear
        ref, dead = events(self, l0, l1, ref, state.dead, u, sign, bins)
        state.reference = (ref - drift).int()
        state.dead = (dead - 1).clamp(min=0)
        state.level, state.source = level.int(), source

    def _levels(self, frame: Tensor) -> tuple[Tensor, Tensor]:
        """Return the frame's levels before and after the low-pass."""
        y, state = lookup(self.job.level, frame), self.state
        if not len(self.job.low_pass):
            return y, y.long()
        nodes = self.job.low_pass.shape[2]
        tables, row = self.job.low_pass.flatten(), 2 * nodes * self.clip["low_pass"]
        keep, lag = (lookup(tables, frame, row + at).long() for at in (0, nodes))
        old = (state.level - state.source).long() * keep - (y - state.source).long() * lag
        return y, y + ((old + 2**19) >> 20)

    def _noise(self, frame: Tensor, number: int) -> tuple[Tensor, Tensor]:
        """Return time (NEVER for none) and polarity of the noise events of interval `number`."""
        seen = (frame.clamp(0, 1) * 256).long()
        shot = self.clip["shot"]
        rate = shot - (shot >> 8) * ((3 * seen) >> 2)
        rate = torch.where(self.hot, self.clip["hot"], rate)
        counter = (number << 32) + 2 * self.pixel
        key = self.keys[SHOT_KEY]
        drawn, at = (noise.bits(key, counter + word) for word in (0, 1))
        u = ((at >> 9).float() + 0.5) * 2.0**-23
        return torch.where(drawn < rate, u, NEVER), torch.where(at & 1 == 1, 1, -1)

    def level_at(self, l0: Tensor, delta: Tensor, u: Tensor) -> Tensor:
        """Return the level at fraction `u` of the interval."""
        return l0 + torch.round(u * delta.float()).long()


def _spread(threshold: Tensor, spread: Tensor, normals: Tensor, drawn: Tensor) -> Tensor:
    cell, inside = drawn >> 20, drawn & 0xFFFFF
    normal = normals[cell] + (((normals[cell + 1] - normals[cell]) * inside) >> 20)
    spread_out = threshold + ((((threshold * spread) >> 20) * normal) >> 20)
    return torch.maximum(spread_out, threshold >> 2)


def _next(l0, delta, ref, on, off, now) -> tuple[Tensor, Tensor]:
    """Return (time, polarity) of the first threshold exceeded at or after `now`."""
    up = delta >= 0
    ahead = torch.where(up, ref + on - l0, l0 - ref + off)
    behind = torch.where(up, ref - off - l0, l0 - ref - on)
    speed, s = delta.abs().float(), torch.where(up, 1, -1)
    crossing = torch.maximum(now, ahead.float() / speed.clamp(min=1))
    u = torch.where(ahead.float() > speed, NEVER, torch.where(ahead <= 0, now, crossing))
    before = (behind >= 0) & (behind.float() >= now * speed)
    return torch.where(before, now, u), torch.where(before, -s, s)


def _linear(pixels: Pixels, l0, l1, ref, dead, noise_u, noise_sign, bins) -> tuple[Tensor, Tensor]:
    """Events at their crossing times, up to the noise event and then up to the end."""
    job, delta, wait = pixels.job, l1 - l0, pixels.wait
    holds = (wait > 0) & (job.mode == HOLD)
    start, stop = torch.zeros_like(dead), noise_u.clamp(max=1)
    holding = (dead > 0) if job.mode == HOLD else torch.zeros_like(dead, dtype=torch.bool)
    for noisy in (True, False):
        going = torch.ones_like(holding)
        while going.any():
            ends = holding & (dead <= stop) & going
            ref, holding = torch.where(ends, pixels.level_at(l0, delta, dead), ref), holding & ~ends
            now = start if job.mode == DELETE else torch.maximum(start, dead)
            u, s = _next(l0, delta, ref, pixels.on, pixels.off, now)
            going = going & ~holding & (u <= stop)
            ref = torch.where(going, ref + torch.where(s > 0, pixels.on, -pixels.off), ref)
            start = torch.where(going, u, start)
            fired = going & (u >= dead)
            bins.add(fired, u, s)
            dead = torch.where(fired, u + wait, dead)
            holding = holding | (fired & holds)
        if noisy:
            fired = (noise_u <= 1) & (noise_u >= dead)
            bins.add(fired, noise_u, noise_sign)
            ref = torch.where(fired, pixels.level_at(l0, delta, noise_u), ref)
            dead = torch.where(fired, noise_u + wait, dead)
            holding = holding | (fired & holds)
            start, stop = stop, torch.ones_like(stop)
    return ref, dead


def _v2e(pixels: Pixels, l0, l1, ref, dead, noise_u, noise_sign, bins) -> tuple[Tensor, Tensor]:
    """Events at v2e's stamps; see v2e_events of the kernel."""
    job, on, off, wait = pixels.job, pixels.on, pixels.off, pixels.wait
    if job.mode == HOLD:
        over = (dead > 0) & (dead <= 1)
        ref = torch.where(over, pixels.level_at(l0, l1 - l0, dead), ref)
    crossings = torch.where(l1 >= ref, (l1 - ref) // on, (ref - l1) // off)
    if job.mode == HOLD:
        crossings = torch.where(dead > 1, 0, crossings)
    steps = crossings.amax((2, 3), keepdim=True).clamp(min=1).float()
    tested = wait * steps > 1
    going = torch.ones_like(tested).expand_as(dead)
    for i in range(1, int(crossings.max()) + 1):
        stamp = torch.full_like(dead, i) / steps
        s = torch.where(l1 - ref >= on, 1, torch.where(ref - l1 >= off, -1, 0))
        going = going & (i <= crossings) & (s != 0)
        kept = going & (~tested | (stamp > dead))
        bins.add(kept, stamp, s)
        dead = torch.where(kept & tested, stamp + wait, dead)
        moves = going if job.mode == DELETE else kept
        ref = torch.where(moves, ref + torch.where(s > 0, on, -off), ref)
        if job.mode == HOLD:
            reset = kept & tested
            going = going & ~(reset & (dead > 1))
            ref = torch.where(reset & (dead <= 1), pixels.level_at(l0, l1 - l0, dead), ref)
    fired = noise_u <= 1
    bins.add(fired, torch.ones_like(dead), noise_sign)
    return torch.where(fired, l1, ref), dead
