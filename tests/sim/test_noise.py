"""Numbers by (key, counter): reproducible, uniform, normal, independent of order."""

import math

import numpy as np
import torch

from src.sim import noise


def test_key_is_stable_and_tells_words_apart():
    assert noise.key(0, "train", 3) == noise.key(0, "train", 3)
    assert noise.key(0, "train", np.int64(3)) == noise.key(np.uint16(0), "train", 3)
    keys = {noise.key(0, "a", 1), noise.key(0, "a", "1"), noise.key(0, "a1"), noise.key("a", 0, 1)}
    assert len(keys) == 4


def test_a_number_depends_on_its_counter_only():
    counters = torch.arange(1000)
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(1))
    assert torch.equal(noise.normal(7, counters)[order], noise.normal(7, counters[order]))


def test_bits_are_balanced_and_uncorrelated():
    count = 200_000
    drawn = noise.bits(noise.key("bits"), torch.arange(count))
    assert int(drawn.min()) >= 0 and int(drawn.max()) < 2**32
    tolerance = 5 * 0.5 / math.sqrt(count)
    planes = ((drawn[:, None] >> torch.arange(32)) & 1).double()
    assert (planes.mean(0) - 0.5).abs().max() < tolerance
    centred = planes - 0.5
    neighbours = (centred[1:] * centred[:-1]).mean(0) / 0.25
    assert neighbours.abs().max() < 5 / math.sqrt(count)


def test_uniform_and_normal_have_the_right_moments():
    count = 200_000
    u = noise.uniform(3, torch.arange(count)).double()
    assert float(u.min()) > 0 and float(u.max()) < 1
    assert abs(float(u.mean()) - 0.5) < 5 * math.sqrt(1 / 12 / count)
    z = noise.normal(4, torch.arange(count)).double()
    assert abs(float(z.mean())) < 5 / math.sqrt(count)
    assert abs(float(z.var()) - 1) < 5 * math.sqrt(2 / count)
    assert abs(float((z**4).mean()) - 3) < 5 * math.sqrt(96 / count)


def test_keys_give_independent_numbers():
    count = 100_000
    a, b = (noise.normal(noise.key("view", view), torch.arange(count)) for view in (1, 2))
    assert abs(float((a * b).mean())) < 5 / math.sqrt(count)


def test_a_few_numbers_are_the_tensor_s():
    for key in (noise.key("a"), noise.key("b", 3), 0):
        assert noise.uniforms(key, 40) == noise.uniform(key, torch.arange(40)).tolist()
    assert noise.uniforms(1, 0) == []
