"""Scores at another resolution than that of the frames."""

import pytest
import torch

from src.metrics.scores import Scores


def clip() -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    target = torch.rand(3, 1, 48, 48)
    return (target + 0.1 * torch.randn_like(target)).clamp(0, 1), target


def test_repeated_pixels_change_ssim_and_not_psnr():
    own, larger = Scores()(*clip()), Scores(scale=3)(*clip())
    assert larger["psnr"] == pytest.approx(own["psnr"], abs=1e-4)
    assert larger["psnr_aligned"] == pytest.approx(own["psnr_aligned"], abs=1e-4)
    assert larger["ssim"] != pytest.approx(own["ssim"], abs=0.01)


def test_averaged_areas_lose_noise():
    assert Scores(scale=1 / 3)(*clip())["psnr"] > Scores()(*clip())["psnr"] + 3


@pytest.mark.parametrize("scale", [0, -1, 1.5, 9])
def test_other_scales_are_refused(scale):
    with pytest.raises(ValueError, match=r"metrics\.scale"):
        Scores(scale=scale)
