"""The sensor in plain torch, for any device: the kernel's formula, all pixels of a frame at once.

Integers and single divisions are the kernel's, so that the events are the same bit for bit.
"""

import torch
from torch import Tensor

from src.sim import noise
from src.sim.sensor.engines.job import DELETE, HOLD, NORMALS, Job
from src.sim.sensor.response import lookup

NEVER = 2.0  # a time after the interval


def voxels(job: Job, grids: Tensor) -> Tensor:
    """Fill `grids` (n, views, windows, bins, h, w) and return them; `job.state` moves on."""
    pixels = Pixels(job)
    frames = job.frames.unbind(2)
    if job.fresh:
        pixels.start(frames[0])
    for i, frame in enumerate(frames[int(job.fresh) :]):
        window, first = i // job.substeps, i % job.substeps == 0
        grid = grids[:, :, window]
        if first:
            grid.zero_()
        pixels.advance(frame, job.state.frame + i, Bins(job.edges, i, job.substeps, grid))
    return grids


class Bins:
    """Adds events of one interval to its window's grid (n, views, bins, h, w)."""

    def __init__(self, edges, i: int, substeps: int, grid: Tensor):
        window = i // substeps * substeps
        self.start = int(edges[i] - edges[window])
        self.ticks = float(edges[i + 1] - edges[i])
        length = torch.tensor(float(edges[window + substeps] - edges[window]))
        self.scale = (torch.tensor(grid.shape[2] - 1.0) / length).to(grid.device)
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
    """All pixels of a batch; the attributes of `job.state` are replaced as time goes on."""

    def __init__(self, job: Job):
        self.job, self.state = job, job.state
        device, (n, _, _, h, w) = job.frames.device, job.frames.shape
        top, left, full_width = job.place
        rows = torch.arange(top, top + h, device=device)[:, None] * full_width
        self.pixel = rows + torch.arange(left, left + w, device=device)
        chips = torch.from_numpy(job.chips).to(device)[:, :, None, None, None]
        normals = torch.from_numpy(NORMALS).to(device)
        spread, hot = torch.from_numpy(job.chip_keys).to(device)[:, :, None, None].unbind(1)
        self.on, self.off = (
            _spread(chips[:, side], chips[:, 2], normals, noise.bits(spread, 2 * self.pixel + side))
            for side in (0, 1)
        )
        self.hot = (noise.bits(hot, self.pixel) < job.chips[0, 3]).expand(n, -1, h, w)

    def start(self, frame: Tensor) -> None:
        """Set the memory to the first frame (n, views, h, w)."""
        level, state = lookup(self.job.tables[0], frame), self.state
        state.level, state.source, state.reference = level, level.clone(), level.clone()
        state.dead = torch.zeros_like(frame)

    def advance(self, frame: Tensor, number: int, bins: Bins) -> None:
        """Take all pixels through interval `number`, which ends with `frame`."""
        state, job = self.state, self.job
        source, level = self._levels(frame)
        leak = self.on * job.leak
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
        table, decay, lag = self.job.tables
        y, state = lookup(table, frame), self.state
        if len(decay) == 1:
            return y, y.long()
        keep, lag = lookup(decay, frame).long(), lookup(lag, frame).long()
        old = (state.level - state.source).long() * keep - (y - state.source).long() * lag
        return y, y + ((old + 2**19) >> 20)

    def _noise(self, frame: Tensor, number: int) -> tuple[Tensor, Tensor]:
        """Return time (NEVER for none) and polarity of the noise events of interval `number`."""
        seen = (frame.clamp(0, 1) * 256).long()
        rate = self.job.shot - (self.job.shot >> 8) * ((3 * seen) >> 2)
        rate = torch.where(self.hot, self.job.hot, rate)
        counter = (number << 32) + 2 * self.pixel
        keys = torch.from_numpy(self.job.shot_keys).to(frame.device)[:, :, None, None]
        drawn, at = (noise.bits(keys, counter + word) for word in (0, 1))
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
    job, delta = pixels.job, l1 - l0
    wait = torch.tensor(job.wait, dtype=torch.float32, device=dead.device)
    holds = job.mode == HOLD and job.wait > 0
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
    job, on, off = pixels.job, pixels.on, pixels.off
    wait = torch.tensor(job.wait, dtype=torch.float32, device=dead.device)
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
