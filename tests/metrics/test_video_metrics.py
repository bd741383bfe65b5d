"""Scores of clips, their means, and another resolution than that of the frames."""

import math

import pytest
import torch

from src.metrics.video_metrics import VideoMetrics, resample
from tests.metrics.test_temporal import photo, swing


def clip(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(3, 1, 48, 48, generator=generator)
    return (target + 0.1 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def test_means_are_over_clips_whatever_their_length():
    metrics = VideoMetrics()
    long, short = clip(0), tuple(part[:2] for part in clip(1))
    values = [metrics(*long), metrics(*short)]
    for name, mean in metrics.compute().items():
        assert float(mean) == pytest.approx(sum(v[name] for v in values) / 2, rel=1e-5)
    assert values[0] == VideoMetrics()(*long), "a clip's scores do not depend on those before"
    metrics.reset()
    assert metrics(*short) == values[1]


def test_scores_that_are_equal_on_a_clip_stay_apart():
    target = clip()[1]
    metrics = VideoMetrics()
    assert metrics(target, target)["psnr"] == metrics(target, target)["psnr_aligned"] == 100
    other = metrics(0.5 * target, target)
    assert other["psnr"] < 20 < other["psnr_aligned"]
    assert float(metrics.compute()["psnr"]) < float(metrics.compute()["psnr_aligned"])


def test_repeated_pixels_change_ssim_and_not_psnr():
    own, larger = VideoMetrics()(*clip()), VideoMetrics(resolution_scale=3)(*clip())
    assert larger["psnr"] == pytest.approx(own["psnr"], abs=1e-4)
    assert larger["psnr_aligned"] == pytest.approx(own["psnr_aligned"], abs=1e-4)
    assert larger["ssim"] != pytest.approx(own["ssim"], abs=0.01)


def moving_pair() -> tuple[torch.Tensor, torch.Tensor]:
    shifts = swing(1.5)
    return photo(shifts), photo(torch.zeros_like(shifts))


def test_repeated_pixels_multiply_jitter():
    own, larger = VideoMetrics()(*moving_pair()), VideoMetrics(resolution_scale=3)(*moving_pair())
    assert own["temporal_jitter_px"] > 1
    assert larger["temporal_jitter_px"] == pytest.approx(3 * own["temporal_jitter_px"], rel=1e-5)


def test_a_reduction_measures_an_enlarged_frame_as_the_small_one():
    enlarged = [resample(frames, 3.0) for frames in moving_pair()]
    own, larger = VideoMetrics()(*moving_pair()), VideoMetrics(jitter_reduction=3)(*enlarged)
    assert larger["temporal_jitter_px"] == pytest.approx(3 * own["temporal_jitter_px"], rel=1e-4)


@pytest.mark.parametrize("reduction", [0, 9])
def test_other_reductions_are_refused(reduction):
    with pytest.raises(ValueError, match=r"metrics\.jitter_reduction must be one of 1\.\.8"):
        VideoMetrics(jitter_reduction=reduction)


def test_averaged_areas_lose_noise():
    assert (
        VideoMetrics(resolution_scale=1 / 3)(*clip())["psnr"] > VideoMetrics()(*clip())["psnr"] + 3
    )


@pytest.mark.parametrize("scale", [0, -1, 1.5, 9])
def test_other_scales_are_refused(scale):
    with pytest.raises(ValueError, match=r"metrics\.resolution_scale"):
        VideoMetrics(resolution_scale=scale)


def test_frames_without_contrast_have_no_aligned_psnr_and_no_jitter():
    target = photo(swing(1.0))
    frames = photo(swing(1.3)) + 0.05 * torch.randn(target.shape)
    blank = torch.full_like(target[:3], 0.1)
    blank[:, :, 0, 0] += 0.04  # a pixel that is hardly seen
    scores = VideoMetrics().forward(frames, target)
    longer = torch.cat([torch.rand_like(blank), frames]), torch.cat([blank, target])
    with_blank = VideoMetrics().forward(*longer)
    for name in ("psnr_aligned", "temporal_jitter_px"):
        assert with_blank[name] == pytest.approx(scores[name], rel=1e-5)


def test_a_clip_without_contrast_has_no_such_score_and_no_part_in_the_mean():
    metrics, blank = VideoMetrics(), torch.full((3, 1, 48, 48), 0.1)
    seen, unseen = metrics(*moving_pair()), metrics(blank, blank)
    assert unseen["psnr_aligned"] is None and unseen["temporal_jitter_px"] is None
    assert unseen["psnr"] == 100 and VideoMetrics()(*moving_pair()) == seen
    for name in ("psnr_aligned", "temporal_jitter_px"):
        assert float(metrics.compute()[name]) == pytest.approx(seen[name], rel=1e-6)


def test_pairs_of_frames_without_texture_have_no_jitter():
    frames, target = moving_pair()
    ramp = torch.linspace(0.3, 0.7, target.shape[-1]).expand_as(target[:3])
    longer = torch.cat([torch.rand_like(ramp), frames]), torch.cat([ramp, target])
    jitter = VideoMetrics()(*longer)["temporal_jitter_px"]
    assert jitter == pytest.approx(VideoMetrics()(frames, target)["temporal_jitter_px"], rel=1e-5)
    assert VideoMetrics()(torch.rand_like(ramp), ramp)["temporal_jitter_px"] is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_network_s_own_frames_of_no_numbers_have_the_score_nan(value):
    frames, target = moving_pair()
    scores = VideoMetrics()(torch.full_like(frames, value), target)
    assert all(map(math.isnan, scores.values())) and len(scores) == 4
