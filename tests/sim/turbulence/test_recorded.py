"""Tilt from footage: known warps are found back; the pieces of the views; what is refused."""

import cv2
import numpy as np
import pytest
import torch

from src.sim.noise import generator
from src.sim.optics import layout
from src.sim.turbulence.contract import ClipTurbulence, TurbulenceModel
from src.sim.turbulence.footage_displacement import (
    UnitRmsDisplacement,
    fit_displacement_field,
    track_displacement_fields,
)
from src.sim.turbulence.recorded import RecordedTurbulence, RecordedTurbulenceOperator

RMS = {"weak": 0.5, "medium": 1.0, "strong": 2.0}
SIDE, FRAMES = 256, 12
RUN = {"height": 64, "width": 64, "fps": 120.0}


def warps() -> np.ndarray:
    """Return smooth displacements (frames, 2, h, w) whose mean over time is zero."""
    rng = np.random.default_rng(0)
    drawn = rng.standard_normal((FRAMES, 2, 5, 5)).astype(np.float32)
    drawn -= drawn.mean(0)
    return np.stack([
        [cv2.resize(axis, (SIDE, SIDE), interpolation=cv2.INTER_CUBIC) for axis in frame]
        for frame in drawn
    ])  # fmt: skip


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """Write footage of a textured still scene seen through `warps`."""
    folder = tmp_path_factory.mktemp("still")
    rng = np.random.default_rng(1)
    scene = cv2.GaussianBlur(rng.uniform(0, 255, (SIDE, SIDE)).astype(np.float32), (0, 0), 2.5)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    for number, push in enumerate(warps()):
        seen = cv2.remap(scene, x - push[0], y - push[1], cv2.INTER_CUBIC, borderMode=2)
        cv2.imwrite(str(folder / f"{number:04}.png"), seen.clip(0, 255))
    return folder


@pytest.fixture(scope="module")
def model(footage):
    return RecordedTurbulence(str(footage), tilt_rms_px=RMS)


def test_the_fields_are_the_warps_that_the_footage_was_made_with(footage):
    found = track_displacement_fields(footage)
    left, top = (round((SIDE - size) / 2) for size in (found.width_px, found.height_px))
    assert max(left, top) < 16  # corners fill the frame but for a margin
    place = np.arange(40.0, 216.0, 4.0)
    seen = found.sample(np.arange(FRAMES) * 1.0, place - top, place - left).numpy()
    true = warps()[:, :, 40:216:4, 40:216:4]
    scale = (seen * true).sum() / (seen**2).sum()
    assert np.sqrt(((scale * seen - true) ** 2).mean()) < 0.2 * np.sqrt((true**2).mean())
    assert scale == pytest.approx(np.sqrt((warps() ** 2).mean()), rel=0.15)


def at(found: UnitRmsDisplacement, time: float, *places: float) -> torch.Tensor:
    """Return the field at one time on a square lattice."""
    return found.sample(np.array([time]), np.array(places), np.array(places))


def test_between_corners_and_frames_the_fields_are_smooth_and_pass_through_them():
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 100, (60, 2))
    corners[:4] = [[0, 0], [100, 0], [0, 100], [100, 100]]
    slope = np.stack([0.02 * corners[:, 0] - 1, 0.01 * corners[:, 1]], -1)
    found = fit_displacement_field(slope * np.sin(np.arange(9))[:, None, None], corners)
    whole = at(found, 3.0, *np.arange(0, 101, 10.0))[0]
    assert torch.allclose(whole[0, :, 10] / whole[0, :, 0], torch.tensor(-1.0), atol=1e-2)
    assert found.nodes.square().mean().sqrt() == pytest.approx(1.0, abs=1e-5)
    on, after = at(found, 3.0, 20.0), at(found, 3.02, 20.0)
    assert 0 < float((on - after).abs().max()) < 0.1
    torch.testing.assert_close(
        at(found, 3.0, 4.0)[0, :, 0, 0], found.nodes[3, :, 2, 2], atol=1e-4, rtol=0
    )


def test_beyond_its_ends_the_footage_is_mirrored_in_place_and_time():
    found = UnitRmsDisplacement(torch.randn(5, 2, 6, 7, generator=generator(0)), 10.0, 12.0)
    inside = found.sample(np.array([1.3]), np.array([2.0]), np.array([3.0]))
    beyond = found.sample(np.array([8 - 1.3]), np.array([-2.0]), np.array([24 - 3.0]))
    torch.testing.assert_close(inside, beyond, atol=1e-5, rtol=0)
    turn = [at(found, time, 4.0, 5.0) for time in (3.9, 4.0, 4.1)]  # level there: no jerk
    assert float((turn[1] - turn[0]).abs().max()) < 0.15
    torch.testing.assert_close(turn[0], turn[2], atol=1e-5, rtol=0)


def test_both_sides_of_the_contract_are_kept(model):
    air = model.operator(model.draw(generator(0)), views=layout(9), **RUN)
    assert isinstance(model, TurbulenceModel) and isinstance(air, ClipTurbulence)
    strength = air.metadata["severity"]
    assert (
        air.metadata["tilt_px"] == RMS[strength] and air.metadata["blur_px"] == 0.4 * RMS[strength]
    )
    drawn = {model.draw(generator(k)) for k in range(30)}
    assert drawn == set(RMS)


def test_a_view_depends_on_its_own_position_and_a_crop_is_that_part_of_the_whole(model):
    frames, strong = torch.rand(1, 3, 64, 64), "strong"
    nine = model.operator(strong, views=layout(9), **RUN)
    one = model.operator(strong, views=layout(1), **RUN)
    whole = nine.degrade(frames, generator(3))
    assert whole.shape == (1, 9, 3, 64, 64)
    assert torch.equal(whole[:, 4:5], one.degrade(frames, generator(3)))
    part = nine.degrade(frames, generator(3), crop=(10, 20, 30, 28))
    torch.testing.assert_close(part, whole[..., 10:40, 20:48], atol=1e-5, rtol=0)


def test_the_picture_moves_as_tilt_says_and_a_flat_one_stays_flat(model):
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    frames = (x + 2 * y).expand(1, 4, 64, 64) / 200
    air = model.operator("medium", views=layout(4), **RUN)
    seen, tilt = air.degrade(frames, generator(5)), air.tilt(4, generator(5))
    inner = (..., slice(8, 56), slice(8, 56))
    expected = frames[:, None] - (tilt[:, :, 0] + 2 * tilt[:, :, 1]) / 200
    torch.testing.assert_close(seen[inner], expected[inner], atol=1e-3, rtol=0)
    flat = air.degrade(torch.full_like(frames, 0.4), generator(5))
    torch.testing.assert_close(flat, torch.full_like(flat, 0.4), atol=1e-5, rtol=0)


def test_a_point_is_blurred_as_stated():
    still = UnitRmsDisplacement(torch.zeros(3, 2, 4, 4), 10.0, 10.0)
    air = RecordedTurbulenceOperator(still, "strong", 2.0, layout(1), (33, 33), 0.25, 1.2)
    frames = torch.zeros(1, 1, 33, 33)
    frames[..., 16, 16] = 1
    spot = air.degrade(frames, generator(0))[0, 0, 0]
    away = torch.arange(33) - 16.0
    assert float(spot.sum()) == pytest.approx(1, abs=1e-4)
    assert float((spot.sum(0) * away**2).sum()) == pytest.approx(1.2**2, rel=0.05)
    sharp = RecordedTurbulenceOperator(still, "weak", 0.0, layout(1), (33, 33), 0.25, 0.0)
    assert torch.equal(sharp.degrade(frames, generator(0))[0], frames)


def test_nine_views_look_through_nine_pieces():
    """Each node's value tells where and when it is: no two views see the same piece."""
    frames, side = 36, 64
    place = torch.arange(side, dtype=torch.float32)
    nodes = torch.zeros(frames, 2, side, side)
    nodes[:, 0] = torch.arange(frames)[:, None, None].float()
    nodes[:, 1] = (place // 32)[:, None] * 2 + place // 32
    air = RecordedTurbulenceOperator(
        UnitRmsDisplacement(nodes, 63.0, 63.0),
        "weak",
        1.0,
        layout(9),
        (256, 256),
        0.25,
        0.0,
    )
    for seed in range(4):
        tilt = air.tilt(40, generator(seed), crop=(120, 120, 16, 16)).abs()
        first, second = tilt.mean((1, 3, 4)).unbind(1)  # turned views: x and y change places
        pieces = set()
        for a, b in zip(first.tolist(), second.tolist(), strict=True):
            quarter, time = sorted((a, b))
            pieces.add((round(quarter), int(time // 12)))
        assert len(pieces) == 9


def test_about_half_of_the_views_play_their_piece_backwards():
    clock = torch.arange(40.0)[:, None, None, None].expand(40, 2, 8, 8)
    seen = UnitRmsDisplacement(clock, 63.0, 63.0)
    air = RecordedTurbulenceOperator(seen, "weak", 1.0, layout(9), (16, 16), 0.25, 0.0)
    backwards = 0
    for seed in range(10):
        time = air.tilt(40, generator(seed)).abs().mean((2, 3, 4))
        step = time.diff(dim=1)
        assert torch.equal(step.sign().amin(1), step.sign().amax(1))
        backwards += int((step.mean(1) < 0).sum())
    assert 30 < backwards < 60


def test_mirrored_and_turned_pieces_stay_gradients():
    """A piece of a rotation-free field is one, however it is mirrored and turned."""
    y, x = torch.meshgrid(torch.arange(65.0), torch.arange(65.0), indexing="ij")
    hill = torch.stack([torch.cos(x / 9) * torch.sin(y / 7) / 9,
                        torch.sin(x / 9) * torch.cos(y / 7) / 7])  # fmt: skip
    seen = UnitRmsDisplacement(hill.expand(4, 2, 65, 65), 64.0, 64.0)
    air = RecordedTurbulenceOperator(seen, "weak", 1.0, layout(9), (16, 16), 0.1, 0.0)
    tilt = air.tilt(2, generator(1))
    down = tilt[:, :, 0, 2:, 1:-1] - tilt[:, :, 0, :-2, 1:-1]
    across = tilt[:, :, 1, 1:-1, 2:] - tilt[:, :, 1, 1:-1, :-2]
    assert float((down - across).abs().max()) < 2e-3
    assert float(down.abs().max()) > 0.01


def moving(folder, count=10):
    """Write frames of a scene that pans by 12 px a frame, its texture new at every frame."""
    folder.mkdir()
    rng = np.random.default_rng(3)
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (96, 400)).astype(np.float32), (0, 0), 2)
    wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:03}.png"), wide[:, 12 * k : 12 * k + 96])
    return folder


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"footage": None}, "turbulence.footage must be a video or folder of frames .*got None"),
        ({"footage": "/nowhere"}, "turbulence.footage must be .*got /nowhere"),
        ({"severity": "wild"}, "turbulence.severity must be mixed, weak, medium, strong, got wild"),
        (
            {"tilt_rms_px": {"weak": -1.0}},
            r"turbulence.tilt_rms_px.weak must be in \[0, 8\] pixels, got -1",
        ),
        ({"footage_fps": 0.0}, "turbulence.footage_fps must be > 0"),
        ({"blur_over_tilt": float("nan")}, "turbulence.blur_over_tilt must be in"),
    ],
)
def test_a_wrong_value_names_its_key(footage, options, said):
    with pytest.raises(ValueError, match=said):
        RecordedTurbulence(**{"footage": str(footage), "tilt_rms_px": RMS} | options)


def test_footage_that_will_not_do_is_refused(tmp_path, footage):
    with pytest.raises(ValueError, match="turbulence.footage must hold videos or folders"):
        track_displacement_fields(tmp_path)
    with pytest.raises(
        ValueError, match="turbulence.footage must be a still scene of which 20 cor"
    ):
        track_displacement_fields(moving(tmp_path / "pan"))
    moving(tmp_path / "short", count=7)
    with pytest.raises(
        ValueError, match="turbulence.footage must be footage of 8 frames or more, got 7"
    ):
        track_displacement_fields(tmp_path / "short")
    with pytest.raises(ValueError, match="one video or one folder of frames, got 2"):
        track_displacement_fields(tmp_path)
    flat = tmp_path / "flat"
    flat.mkdir()
    for k in range(9):
        cv2.imwrite(str(flat / f"{k}.png"), np.full((64, 64), 90, np.uint8))
    with pytest.raises(ValueError, match="got 0 of 0 in"):
        track_displacement_fields(flat)


def test_views_that_would_share_a_piece_are_refused(model):
    assert model.operator("weak", views=layout(9), **RUN)
    for views in (layout(25), [(0, 0), (0, 3)]):
        with pytest.raises(ValueError, match="optics must have at most nine views, within 3x3"):
            model.operator("weak", views=views, **RUN)


def test_the_real_footage_moves_locally(shared_data):
    found = track_displacement_fields(shared_data / "turbulence" / "building")
    assert found.nodes.shape[0] == 40 and min(found.width_px, found.height_px) > 190
    power = found.nodes.square().mean((0, 1))
    assert float(power.max().sqrt()) < 2 and float(power.min().sqrt()) > 0.5
    whole = found.nodes.mean((2, 3)).square().mean()
    assert 0.15 < float(whole) < 0.45  # share of the power that is one shift of the frame
    near, far = (found.nodes[..., lag:] * found.nodes[..., :-lag] for lag in (2, 40))
    assert float(near.mean()) > 0.85 and float(far.mean()) < 0.45
