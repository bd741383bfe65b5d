"""What holds a picture steady from window to window."""

import torch

from src.training.steadiness import STILL, flicker, unrest

ALL = torch.tensor([True, True])


def pictures(seed: int = 0):
    return torch.rand(2, 3, 1, 8, 8, generator=torch.Generator().manual_seed(seed))


def test_flicker_is_of_the_error_and_unrest_of_the_picture():
    moving = pictures()
    assert flicker(moving, moving, ALL) == 0  # a picture that is right may move ...
    assert unrest(moving, moving, ALL) == 0  # ... where the truth does
    still = moving[:, :1].expand_as(moving)
    assert flicker(moving, still, ALL) > 0.1 and unrest(moving, still, ALL) > 0.1
    assert unrest(still, moving, ALL) == 0


def test_a_fainter_picture_is_not_calmer():
    seen, still = pictures(), torch.zeros(2, 3, 1, 8, 8)
    whole, faint = unrest(seen, still, ALL), unrest(0.5 * seen, still, ALL)
    assert abs(faint / whole - 1) < 0.02
    assert flicker(0.5 * seen, still, ALL) < 0.51 * flicker(seen, still, ALL)


def test_only_where_the_truth_stands_and_only_pairs_that_follow():
    seen, truth = pictures(), torch.zeros(2, 3, 1, 8, 8)
    truth[:, 1:, :, :, 4:] = 2 * STILL
    truth[:, 2:, :, :, 4:] = 0
    left = unrest(seen, truth, ALL)
    calm = seen.clone()
    calm[..., :4] = seen[:, :1, ..., :4]
    assert left > 0 and unrest(calm, truth, ALL) == 0
    first = torch.tensor([True, False])
    calm = torch.cat([seen[:, :1], seen[:, :1], seen[:, 2:]], 1)
    still = torch.zeros_like(seen)
    assert unrest(calm, still, first) == 0 and unrest(calm, still, ALL) > 0


def test_its_gradient_does_not_ask_for_less_contrast():
    seen, still = pictures().requires_grad_(), torch.zeros(2, 3, 1, 8, 8)
    unrest(seen, still, ALL).backward()
    along = (seen.grad * seen).sum((-2, -1))  # what scaling all windows alike would change
    assert along.sum().abs() < 0.1 * (seen.grad * seen).abs().sum()


def test_flat_pictures_have_a_gradient():
    flat, still = torch.full((2, 3, 1, 8, 8), 0.5).requires_grad_(), torch.zeros(2, 3, 1, 8, 8)
    unrest(flat, still, ALL).backward()
    assert flat.grad.isfinite().all()
