"""Parts of the Triton kernel: what a pixel is, what it sees and the noise it has.

`chip` points to the numbers of a clip, in the order of CLIP; `keys` to the keys of one of its
views.
"""

import triton
import triton.language as tl

from src.sim.sensor.engines import job as jobs
from src.sim.sensor.engines.job import CLIP

LOWEST, HIGHEST = tl.constexpr(jobs.LOWEST), tl.constexpr(jobs.HIGHEST)
NEVER = tl.constexpr(2.0)  # a time after the interval
FIELDS, KEYS = tl.constexpr(len(CLIP.names)), tl.constexpr(jobs.KEYS)
(
    ON, OFF, SPREAD, HOT_SHARE, LEAK, SHOT, HOT, TOP, LEFT, FULL_WIDTH, LOW_PASS, WAIT, RESIDUAL,
) = map(tl.constexpr, range(len(CLIP.names)))  # fmt: skip
MISMATCH_KEY, HOT_KEY = tl.constexpr(jobs.MISMATCH_KEY), tl.constexpr(jobs.HOT_KEY)
SHOT_KEY, RESIDUAL_KEY = tl.constexpr(jobs.SHOT_KEY), tl.constexpr(jobs.RESIDUAL_KEY)


@triton.jit
def chip_of(chip, keys, normals, pixel):
    """Return the pixels' ON and OFF thresholds and which are hot."""
    spread, key = tl.load(chip + SPREAD), tl.load(keys + MISMATCH_KEY)
    none = tl.full((), 0, tl.int64)
    on = spread_threshold(tl.load(chip + ON), spread, normals, random_bits(key, none, 2 * pixel))
    off = spread_threshold(
        tl.load(chip + OFF), spread, normals, random_bits(key, none, 2 * pixel + 1)
    )
    hot = random_bits(tl.load(keys + HOT_KEY), none, pixel).to(tl.int64) < tl.load(chip + HOT_SHARE)
    return on, off, hot


@triton.jit
def spread_threshold(threshold, spread, normals, drawn):
    """Return threshold * (1 + spread * normal), at least a quarter of the threshold."""
    cell, inside = (drawn >> 20).to(tl.int32), (drawn & 0xFFFFF).to(tl.int64)
    left, right = tl.load(normals + cell), tl.load(normals + cell + 1)
    normal = left + (((right - left) * inside) >> 20)
    spread_out = threshold + ((((threshold * spread) >> 20) * normal) >> 20)
    return tl.maximum(spread_out, threshold >> 2).to(tl.int32)


@triton.jit
def residual(chip, keys, pixel, on, off):
    """Return how far a reference is below the first level."""
    drawn = random_bits(tl.load(keys + RESIDUAL_KEY), tl.full((), 0, tl.int64), pixel)
    share = ((drawn >> 9).to(tl.float32) + 0.5) * (1 / 8388608.0)
    away = (2 * share - 1).to(tl.float64) * number64(chip + RESIDUAL)
    return (away * tl.where(away > 0, on, off).to(tl.float64)).to(tl.int32)


@triton.jit
def is_outside(intensity):
    """Return where an intensity is not one: nan as well."""
    return ((intensity >= LOWEST) & (intensity <= HIGHEST)) == 0


@triton.jit
def place_of(intensity):
    """Return the place in the tables of an intensity, as src.sim.sensor.response.lookup has it."""
    bits = intensity.to(tl.int32, bitcast=True)
    return tl.minimum(tl.maximum(bits, 0x38800000), 0x3FFFFFFF) - 0x38800000


@triton.jit
def look(table, place):
    """Return the table's value at a place."""
    left, right = tl.load(table + (place >> 13)), tl.load(table + (place >> 13) + 1)
    return (left + (((right - left) * (place & 8191)) >> 13) + 8) >> 4


@triton.jit
def filtered(read, level, source, decay, lag):
    """Return the new level after the low-pass from the one before it, `read`, and the memory."""
    kept = (level - source).to(tl.int64) * decay - (read - source).to(tl.int64) * lag
    return read + ((kept + 524288) >> 20).to(tl.int32)


@triton.jit
def way(span, u):
    """Return how far a level that moves by `span` in an interval has come at fraction `u`."""
    return nearest(u * span.to(tl.float32)).to(tl.int32)


@triton.jit
def nearest(x):
    """Return `x`, not negative, rounded to the nearest whole number, halves to even."""
    return tl.where(x < 8388608.0, x + 8388608.0 - 8388608.0, x)


@triton.jit
def noise_chance(chip, hot, intensity):
    """Return the probability of a noise event in 2**-32; at white it is a quarter of black's."""
    shot = tl.load(chip + SHOT)
    seen = (tl.minimum(tl.maximum(intensity, 0.0), 1.0) * 256.0).to(tl.int64)
    return tl.where(hot, tl.load(chip + HOT), shot - (shot >> 8) * ((3 * seen) >> 2))


@triton.jit
def noise_event(key, frame, pixel, chance):
    """Return time (NEVER for none) and polarity of the noise events of interval `frame`."""
    drawn, at = random_bits(key, frame, 2 * pixel), random_bits(key, frame, 2 * pixel + 1)
    u = ((at >> 9).to(tl.float32) + 0.5) * (1 / 8388608.0)
    return tl.where(drawn.to(tl.int64) < chance, u, NEVER), tl.where(at & 1 == 1, 1, -1)


@triton.jit
def random_bits(key, high, low):
    """The 32 bits of src.sim.noise.bits(key, high * 2**32 + low)."""
    mixed = mix(low.to(tl.uint32) ^ (key & 0xFFFFFFFF).to(tl.uint32))
    upper = high.to(tl.uint32) * 0x9E3779B9 + (key >> 32).to(tl.uint32)
    return mix(mixed + upper)


@triton.jit
def mix(x):
    """The 32-bit finaliser of src.sim.noise."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


@triton.jit
def number64(at):
    """Return the float64 whose bits are kept as int64."""
    return tl.load(at).to(tl.float64, bitcast=True)
