"""How a clip's own tilt is described, and the turbulence meter on simulated turbulence."""

import cv2
import numpy as np
import pytest

from scripts import check_turbulence_meter as meter


def test_the_given_tilt_is_described_by_rms_half_length_and_share():
    rng, sigma = np.random.default_rng(0), 12.0
    local = [
        [cv2.GaussianBlur(axis, (0, 0), sigma)[64:320, 64:320] for axis in frame]
        for frame in rng.standard_normal((16, 2, 384, 384))
    ]
    local = 0.6 * np.array(local) * 2 * np.sqrt(np.pi) * sigma
    shift = 0.8 * rng.standard_normal((16, 2, 1, 1))
    rms, half, _, decay = meter.describe_tilt(np.repeat(local, 2, axis=0))
    assert rms == pytest.approx(0.6 * np.sqrt(15 / 16), rel=0.06)
    assert half == pytest.approx(1.665 * sigma, rel=0.1)
    assert decay * meter.FPS == pytest.approx(1.3, abs=0.2)  # 1, then a half, then nothing
    assert meter.describe_tilt(local + shift)[2] == pytest.approx(0.64, abs=0.12)


@pytest.mark.slow
@pytest.mark.parametrize("k", [100, 109])
def test_simulated_turbulence_is_measured_within_a_fifth(k, shared_data):
    path = meter.draw_atmosphere(k)
    seen, tilt = meter.simulate_footage(meter.load_photograph(k), path, k)
    found = meter.compare_measurement(
        path, tilt, meter.turbulence_meter.measure_turbulence(seen, meter.FPS).found
    )
    for name in (
        "rms of clip",
        "half length of clip",
        "rms of atmosphere",
        "half length of atmosphere",
    ):
        assert found[name] == pytest.approx(1, abs=0.2), name
    assert found["rms held"] and found["half length held"]
