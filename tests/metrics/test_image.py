"""Image scores against their definitions and against scikit-image."""

import math

import kornia.metrics
import pytest
import skimage
import torch
from skimage.metrics import structural_similarity

from src.metrics.image import aligned_psnr, psnr, ssim


def pair(side: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    photo = torch.from_numpy(skimage.data.camera()[100 : 100 + side, 200 : 200 + side] / 255.0)
    target = photo.float().expand(2, 1, side, side)
    noise = torch.randn(2, 1, side, side, generator=torch.Generator().manual_seed(0))
    return target + 0.05 * noise, target


def test_psnr_of_a_known_error():
    target = torch.full((1, 1, 8, 8), 0.5)
    assert math.isclose(float(psnr(target + 0.1, target)), 20.0, abs_tol=1e-4)
    assert float(psnr(target, target)) == 100.0


def test_psnr_is_per_frame_and_clips_the_prediction():
    target = torch.ones(2, 1, 8, 8)
    prediction = torch.stack([torch.full((1, 8, 8), 1.5), torch.full((1, 8, 8), 0.9)])
    assert torch.allclose(psnr(prediction, target), torch.tensor([100.0, 20.0]), atol=1e-4)


def test_alignment_removes_gain_and_offset_but_not_inversion():
    _, target = pair()
    assert torch.all(aligned_psnr(0.4 * target + 0.2, target) > 90)
    flat = 10 * math.log10(1 / float(target.var(unbiased=False)))
    assert torch.allclose(aligned_psnr(1 - target, target), torch.full((2,), flat), atol=0.05)


def test_alignment_of_a_flat_frame_is_finite():
    _, target = pair()
    assert torch.isfinite(aligned_psnr(torch.full_like(target, 0.3), target)).all()


def test_ssim_agrees_with_scikit_image():
    prediction, target = pair()
    theirs = structural_similarity(
        prediction[0, 0].clamp(0, 1).numpy(),
        target[0, 0].numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    assert math.isclose(float(ssim(prediction, target)[0]), theirs, abs_tol=1e-5)


@pytest.mark.parametrize("size", [(11, 11), (24, 40)])
def test_ssim_and_its_slope_agree_with_kornia(size):
    torch.manual_seed(0)
    truth, scores = torch.rand(3, 1, *size), []
    for score in (
        ssim,
        lambda *pair: kornia.metrics.ssim(*pair, 11, padding="valid").mean((1, 2, 3)),
    ):
        shown = (0.8 * truth + 0.1).requires_grad_()
        with torch.autocast("cpu", torch.bfloat16):  # which both of them keep out
            value = score(shown, truth)
        scores.append([value, torch.autograd.grad(value.sum(), shown)[0]])
    for ours, theirs in zip(*scores, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_ssim_wants_a_window_of_pixels():
    with pytest.raises(ValueError, match="at least 11 pixels"):
        ssim(torch.rand(1, 1, 10, 40), torch.rand(1, 1, 10, 40))


@pytest.mark.parametrize("score", [psnr, aligned_psnr, ssim])
def test_scores_do_not_depend_on_the_batch(score):
    prediction, target = pair()
    assert torch.allclose(score(prediction, target)[1:], score(prediction[1:], target[1:]))
