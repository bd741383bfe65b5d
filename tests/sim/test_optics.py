"""Arrangement of views and residual misalignment."""

import math

import pytest
import torch

from src.sim.optics import Optics, layout, view_id


def test_layouts():
    assert layout(1) == ((0, 0),)
    assert layout(9)[0] == (-1, -1) and layout(9)[4] == (0, 0) and layout(9)[8] == (1, 1)
    assert layout(4) == ((0, 0), (0, 1), (1, 0), (1, 1))
    assert len(set(layout(25))) == 25 and len(layout(5)) == 5


def test_centre_and_ids():
    assert view_id((0, 0)) == 144
    for views in (1, 2, 3, 4, 5, 9, 25):
        optics = Optics(views)
        assert optics.positions[optics.centre] == (0, 0)
        assert len(set(optics.random_key_ids)) == views


@pytest.mark.parametrize("views", [0, -1, 6, 7, 10, 400])
def test_unknown_layout_names_the_key(views):
    with pytest.raises(ValueError, match="optics.views"):
        Optics(views)


@pytest.mark.parametrize(
    ("positions", "key"), [([(0, 0), (0, 0)], "positions"), ([(0, 0), (0, 9)], "positions")]
)
def test_wrong_positions(positions, key):
    with pytest.raises(ValueError, match=f"optics.{key}"):
        _ = Optics(2, positions).random_key_ids


def test_negative_misalignment_is_refused():
    with pytest.raises(ValueError, match="optics.homography_error_px"):
        Optics(9, homography_error_px=-1)


def test_perfect_registration_changes_nothing():
    frames = torch.rand(1, 9, 2, 8, 8)
    assert Optics(9).apply_homography_error(frames, 1) is frames


def test_misalignment_moves_all_views_but_the_centre_by_its_size():
    side = 65
    ramp = torch.arange(side).float().expand(side, side) / side
    frames = ramp.expand(1, 25, 1, side, side)
    optics = Optics(25, homography_error_px=1.0)
    shifts = torch.cat(
        [
            (optics.apply_homography_error(frames, key) - frames)[0, :, 0, 32, 32] * side
            for key in range(20)
        ]
    ).reshape(20, 25)
    assert torch.all(shifts[:, optics.centre] == 0)
    others = torch.cat([shifts[:, :12], shifts[:, 13:]], dim=1)
    # The middle goes to where the diagonals cross; across each diagonal it moves by the mean of
    # two corners, so its standard deviation per axis is sqrt(1/2) of a corner's.
    expected = math.sqrt(0.5)
    assert abs(float(others.std()) - expected) < 4 * expected / math.sqrt(2 * others.numel())


def test_a_crop_is_misaligned_as_the_whole_frame():
    frames = torch.rand(1, 9, 1, 48, 48, generator=torch.Generator().manual_seed(0))
    optics = Optics(9, homography_error_px=0.7)
    whole = optics.apply_homography_error(frames, 3)[..., 16:32, 8:32]
    crop = optics.apply_homography_error(
        frames[..., 16:32, 8:32], 3, origin=(16, 8), full_size=(48, 48)
    )
    assert torch.allclose(whole[..., 3:-3, 3:-3], crop[..., 3:-3, 3:-3], atol=1e-5)
