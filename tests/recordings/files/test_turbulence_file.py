"""Air that was measured: what its file may hold, and clips that show what it says."""

import numpy as np
import pytest
import torch
import yaml

from src.app import simulation
from src.recordings.files.turbulence_file import (
    IntervalEstimate,
    MeasuredTurbulence,
    TurbulenceFile,
    read_turbulence_file,
)
from src.sim.pipeline import simulate
from src.sim.turbulence import outer_scale
from src.sim.turbulence.prior import unnormalised_cn2_profile
from src.sim.turbulence.simulated import SimulatedTurbulence
from tests.test_train import config

SITE = {
    "tilt_rms_px": [0.5, 0.4, 0.6],
    "tilt_correlation_half_length_px": [15.0, 12.0, 18.0],
    "global_tilt_share": [0.1, 0.05, 0.15],
    "tilt_correlation_time_s": [0.05, 0.04, 0.06],
    "blur_px": [0.4, 0.25, 0.65],
}
RANGES = {"tilt_correlation_time_s": (0.1, 0.2)}


def site(path, **changes) -> str:
    """Write an air.yaml of SITE, with changes; None leaves a key out."""
    rows = {key: value for key, value in (SITE | changes).items() if value is not None}
    content = {
        key: {"value": row[0], "interval": row[1:]} if isinstance(row, list) else row
        for key, row in rows.items()
    }
    path.write_text(yaml.safe_dump(content))
    return str(path)


def test_a_file_is_read_as_it_was_written(tmp_path):
    written = TurbulenceFile(**{key: IntervalEstimate(*row) for key, row in SITE.items()})
    (tmp_path / "air.yaml").write_text(written.to_yaml())
    assert read_turbulence_file(tmp_path / "air.yaml") == written
    bound = TurbulenceFile(
        **vars(written) | {"tilt_correlation_time_s": IntervalEstimate(None, None, 0.04)}
    )
    (tmp_path / "air.yaml").write_text(bound.to_yaml())
    assert read_turbulence_file(tmp_path / "air.yaml") == bound


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"tilt_rms_px": [-1.0, 0.1, 0.2]}, "tilt_rms_px must be in 0.001..30, got -1.0"),
        ({"tilt_rms_px": [None, None, None]}, "tilt_rms_px must be in .* got None"),
        ({"tilt_rms_px": [0.5, 0.6, 0.7]}, "tilt_rms_px must lie in its interval"),
        (
            {"tilt_correlation_half_length_px": [15.0, 0.1, 20.0]},
            "tilt_correlation_half_length_px must be in 1..2000, got 0.1",
        ),
        ({"global_tilt_share": [0.5, 0.2, 1.5]}, "global_tilt_share must be in 0..1, got 1.5"),
        (
            {"tilt_correlation_time_s": [float("nan"), 0.0, 1.0]},
            "tilt_correlation_time_s must be in",
        ),
        (
            {"tilt_correlation_time_s": ["fast", 0.1, 1.0]},
            "tilt_correlation_time_s must hold numbers, got fast",
        ),
        ({"blur_px": [1.2, 0.0, 1.3]}, "blur_px must be in 0.001..30, got 0.0"),
        ({"blur_px": [True, 1.0, 1.3]}, "blur_px must hold numbers, got True"),
        (
            {"tilt_correlation_time_s": None},
            "its keys must be tilt_rms_px, tilt_correlation_half_length_px",
        ),
        ({"more": [1, 1, 1]}, "its keys must be"),
        (
            {"decay_s": [1, 1, 1], "rms_px": [1, 1, 1], "tilt_rms_px": None},
            "rms_px is now tilt_rms_px, decay_s is now tilt_correlation_time_s; their values are",
        ),
        ({"tilt_rms_px": 0.5}, "tilt_rms_px must hold value and interval"),
        ({"tilt_rms_px": [0.5, 0.4]}, "tilt_rms_px must hold value and interval"),
    ],
)
def test_a_file_with_wrong_values_is_refused(changes, message, tmp_path):
    path = site(tmp_path / "air.yaml", **changes)
    with pytest.raises(ValueError, match="turbulence.measured must be a file of .*: .*" + message):
        read_turbulence_file(path)


@pytest.mark.parametrize("text", ["[1, 2]", "a: &a [1]\nb: *a", "{", "\0"])
def test_what_is_no_such_file_is_refused(text, tmp_path):
    (tmp_path / "air.yaml").write_text(text)
    with pytest.raises(ValueError, match="turbulence.measured must be a file of"):
        read_turbulence_file(tmp_path / "air.yaml")
    with pytest.raises(ValueError, match="turbulence.measured must be a file of"):
        read_turbulence_file(tmp_path / "nowhere.yaml")
    with pytest.raises(ValueError, match="turbulence.measured must be a file of .* got None"):
        read_turbulence_file(None)


def draws(air: MeasuredTurbulence, count: int = 30) -> list:
    return [air.draw(torch.Generator().manual_seed(seed)) for seed in range(count)]


def test_clips_show_what_the_file_says(tmp_path):
    paths = draws(MeasuredTurbulence(site(tmp_path / "air.yaml"), RANGES))
    tilts = np.array([path.tilt_std_px(256) for path in paths])
    assert tilts.min() > 0.4 * 0.97 and tilts.max() < 0.6 * 1.03 and np.ptp(tilts) > 0.1
    lengths = np.array([path.tilt_correlation_half_length_px(256) for path in paths])
    assert lengths.min() > 12 * 0.9 and lengths.max() < 18 * 1.1 and np.ptp(lengths) > 3
    decays = np.array([-1 / (120 * np.log(path.ar1_coefficient)) for path in paths])
    assert decays.min() > 0.039 and decays.max() < 0.061
    blurs = np.array([path.blur_px(256) for path in paths])
    assert blurs.min() > 0.25 * 0.9 and blurs.max() < 0.65 * 1.1 and np.ptp(blurs) > 0.2
    shares = [
        outer_scale.global_tilt_share(
            path.aperture_m / path.outer_scale_m,
            tuple(np.array(path.cn2_profile) / max(path.cn2_profile)),
            256 * path.pixel_size_at_object_m(256) / path.aperture_m,
        )
        for path in paths
    ]
    assert np.median(np.abs(np.array(shares) - 0.1)) < 0.06


@pytest.mark.parametrize("size", [(256, 256), (144, 256), (288, 512), (512, 288)])
def test_lengths_are_of_a_frame_whose_smaller_side_is_256(size, tmp_path):
    exact = {
        "tilt_rms_px": [0.5] * 3,
        "tilt_correlation_half_length_px": [15.0] * 3,
        "global_tilt_share": [0.1, 0.0, 0.3],
    }
    air = MeasuredTurbulence(site(tmp_path / "air.yaml", **exact), RANGES)
    height, width = size
    given = {"views": [(0, 0)], "height": height, "width": width, "fps": 120.0}
    seen = air.operator(draws(air, 1)[0], **given).metadata
    assert seen["tilt_px"] == pytest.approx(0.5 * min(size) / 256, rel=0.03)
    length = seen["tilt_correlation_half_length_px"]
    assert length == pytest.approx(15 * min(size) / 256, rel=0.1)


def test_what_the_file_does_not_know_is_drawn_from_the_ranges(tmp_path):
    unknown = site(tmp_path / "air.yaml", tilt_correlation_time_s=[None, None, None])
    decays = [
        -1 / (120 * np.log(path.ar1_coefficient))
        for path in draws(MeasuredTurbulence(unknown, RANGES))
    ]
    assert min(decays) > 0.099 and max(decays) < 0.201
    bound = site(tmp_path / "air.yaml", tilt_correlation_half_length_px=[None, 120.0, None])
    lengths = [
        path.tilt_correlation_half_length_px(256)
        for path in draws(MeasuredTurbulence(bound, RANGES), 10)
    ]
    assert min(lengths) > 108


def test_the_whole_share_is_the_mean_correlation_of_two_points():
    rng = np.random.default_rng(0)
    apart = np.hypot(*(rng.uniform(0, 20, (2, 4000)) - rng.uniform(0, 20, (2, 4000))))
    for shape in ("uniform", "object"):
        expected = outer_scale.tilt_correlation(0.1, unnormalised_cn2_profile(shape), apart).mean()
        assert outer_scale.global_tilt_share(
            0.1, unnormalised_cn2_profile(shape), 20.0
        ) == pytest.approx(expected, abs=0.01)


SMALL = ["scene.height=64", "scene.width=64", "data.test_windows=2", "data.test_crop=16"]


def test_turbulence_measured_simulates(tmp_path):
    path = site(tmp_path / "air.yaml")
    chosen = ["turbulence=measured", f"turbulence.measured={path}", "fps=120", *SMALL]
    pipeline = simulation.build_pipeline(config("simulate", tmp_path, *chosen), "test")
    assert isinstance(pipeline.turbulence, SimulatedTurbulence)
    (drawn,) = simulate(pipeline, [0]).parameters
    assert drawn["severity"] in ("weak", "medium")


def test_another_measurement_makes_another_cache(tmp_path):
    path = site(tmp_path / "air.yaml")
    chosen = ["turbulence=measured", f"turbulence.measured={path}", "data.cache_clips=2"]
    cfg = config("train", tmp_path, *chosen, f"data.cache_root={tmp_path}/cache")
    first = simulation.build_clip_cache(cfg).folder
    site(tmp_path / "air.yaml", tilt_rms_px=[0.7, 0.6, 0.8])
    assert simulation.build_clip_cache(cfg).folder != first
