"""Multiply-accumulates of a frame."""

import torch
from torch.nn import functional

from baselines.etnet import ETNet
from src.deploy.cost import count_macs, macs_per_frame


def test_macs_of_a_network_with_attention_are_those_of_its_shapes():
    network = ETNet(base_channels=8).eval()
    assert macs_per_frame(network, 48, 48) == macs_per_frame(network.to("meta"), 48, 48)


def test_attention_is_two_matrix_products():
    q, k, v = (torch.ones(1, 2, tokens, 8) for tokens in (5, 7, 7))
    counted = count_macs(lambda: functional.scaled_dot_product_attention(q, k, v))
    assert counted == 2 * 2 * 5 * 7 * 8
