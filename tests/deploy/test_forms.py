"""What a processor computes fast in."""

import pytest
import torch

from src.deploy import cpu_features


@pytest.mark.parametrize(
    ("able", "bf16_s", "faster"),
    [
        ({"avx512_bf16": True}, 0.5, True),
        ({"avx512_bf16": True}, 2.0, False),  # a Xeon whose AMX is hidden
        ({"amx_bf16": False}, 0.5, False),
        ({}, 0.5, False),
    ],
)
def test_bf16_has_to_be_there_and_faster(able, bf16_s, faster, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: able)
    seconds = {torch.bfloat16: bf16_s, torch.float32: 1.0}
    monkeypatch.setattr(cpu_features, "time_convolution_s", seconds.get)
    assert cpu_features.is_bf16_faster.__wrapped__() == faster


def test_a_convolution_is_timed_in_either():
    assert all(
        0 < cpu_features.time_convolution_s(kind) < 1 for kind in (torch.float32, torch.bfloat16)
    )
