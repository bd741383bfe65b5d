"""Lamps that flicker: the light does, the ground truth does not."""

from functools import partial

import numpy as np
import pytest
import torch

from src.sim.scenes.mixture import MAINS_HZ, Mixture, draw_flicker
from src.sim.scenes.photographs import Photographs

PARTS = {"photos": {"share": 1, "scene": partial(Photographs, max_cutouts=0)}}
FRAME = {"height": 32, "width": 48, "frames": 9, "fps": 480.0}
DEPTHS = (0.05, 0.4)


def lamps(count: int = 60, rate: float = 9600.0, seconds: float = 0.2) -> list[np.ndarray]:
    times = np.arange(int(rate * seconds)) / rate
    return [
        draw_flicker(np.random.default_rng(k), times, (6, 8), DEPTHS).numpy() for k in range(count)
    ]


def test_the_light_flickers_at_twice_the_mains_by_a_depth_within_the_range():
    depths, frequencies, wholes = [], [], 0
    for lamp in lamps():
        place = np.unravel_index(lamp.min(0).argmin(), lamp.shape[1:])
        light = lamp[:, *place]
        depths.append(np.ptp(light) / (light.max() + light.min()))
        spectrum = abs(np.fft.rfft(light - light.mean()))
        frequencies.append(spectrum.argmax() / 0.2)
        wholes += lamp.shape[1:] == (1, 1)
    assert set(frequencies) == {2 * hertz for hertz in MAINS_HZ}
    assert max(depths) < DEPTHS[1] + 1e-3 and max(depths) > 0.3
    assert np.median(depths) < 0.3 and 15 < wholes < 45
    whole = [d for d, lamp in zip(depths, lamps(), strict=True) if lamp.shape[1:] == (1, 1)]
    assert min(whole) > DEPTHS[0] - 2e-3  # a pool of light may have its middle beside the frame


def test_a_lamp_never_makes_more_light_and_a_part_of_the_scene_is_lit_smoothly():
    for lamp in lamps():
        assert lamp.min() > 0.42 and lamp.max() <= 1
        if lamp.shape[1:] != (1, 1):
            assert abs(np.diff(lamp, axis=1)).max() < 0.45 and (np.ptp(lamp, (1, 2)) > 0).any()


def test_flicker_leaves_the_truth_and_takes_its_share_of_clips():
    plain, lit = Mixture(parts=PARTS, **FRAME), Mixture(parts=PARTS, flicker_share=0.25, **FRAME)
    clips = [lit.clip(index) for index in range(120)]
    assert 15 < sum(clip.illumination is not None for clip in clips) < 46  # 30 +- 4.7
    for index in range(12):
        assert torch.equal(clips[index].frames, plain.clip(index).frames)
        assert plain.clip(index).illumination is None
    again = [clip.illumination for clip in (lit.clip(index) for index in range(12))]
    for clip, lamp in zip(clips, again, strict=False):
        assert (clip.illumination is None) == (lamp is None)
        assert lamp is None or torch.equal(clip.illumination, lamp)
    lamp = next(clip.illumination for clip in clips if clip.illumination is not None)
    assert lamp.dtype == torch.float32 and len(lamp) == 9
    torch.broadcast_shapes(lamp.shape, (9, 32, 48))


def test_a_finer_clip_has_the_light_of_the_coarse_one():
    coarse = Mixture(parts=PARTS, flicker_share=1.0, **FRAME)
    fine = Mixture(parts=PARTS, flicker_share=1.0, **FRAME | {"frames": 25, "fps": 1440.0})
    for index in range(6):
        assert torch.allclose(
            coarse.clip(index).illumination, fine.clip(index).illumination[::3], atol=1e-6
        )


def test_no_clip_flickers_at_rates_where_it_would_alias():
    for fps, lit in ((120.0, False), (479.0, False), (480.0, True)):
        scene = Mixture(parts=PARTS, flicker_share=1.0, **FRAME | {"fps": fps})
        assert all((scene.clip(index).illumination is not None) == lit for index in range(4))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"flicker_share": 1.2}, r"scene.flicker_share must be in \[0, 1\], got 1.2"),
        (
            {"flicker_modulation_depth": (0.3, 1.0)},
            "scene.flicker_modulation_depth must be a range 0 <= low <= high < 1",
        ),
        (
            {"flicker_modulation_depth": (0.3, 0.1)},
            "scene.flicker_modulation_depth must be a range",
        ),
        (
            {"flicker_modulation_depth": []},
            r"scene.flicker_modulation_depth must be .*, got \[\]",
        ),
    ],
)
def test_wrong_values_name_their_key(wrong, message):
    with pytest.raises(ValueError, match=message):
        Mixture(parts=PARTS, **FRAME, **wrong)
