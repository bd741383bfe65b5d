"""Pictures that move: what is written is what was shown, whole or not at all."""

import numpy as np
import pytest
from PIL import Image, ImageSequence

from src.figures.samples import (
    GAP_PX,
    TITLE_PX,
    join_panels,
    render_events,
    resize_pictures,
    shrink_events,
    title_events,
    write_animation,
)


def ramp(frames: int, height: int, width: int) -> np.ndarray:
    grey = np.arange(frames * height * width).reshape(frames, height, width, 1) % 11 / 10
    return np.repeat(grey, 3, axis=-1).astype(np.float32)


def test_events_are_red_where_brighter_and_blue_where_darker_on_white():
    off, none, on = render_events(np.array([[[-3.0, 0.0, 3.0]]]))[0, 0]
    assert none.tolist() == [1, 1, 1]
    assert on.argmax() == 0 and off.argmax() == 2
    assert np.allclose(render_events(np.array([[[9.0]]]))[0, 0], on)


def test_fainter_events_are_paler():
    one, two, three = render_events(np.array([[[1.0, 2.0, 3.0]]]))[0, 0, :, 2]
    assert 1 > one > two > three


def test_single_events_of_a_large_view_are_as_dark_when_it_is_shrunk():
    counts = np.zeros((2, 480, 640), np.float32)
    counts[0, 100, 200], counts[0, 101, 201], counts[1, -1, -1] = 1, -2, 1
    small = shrink_events(counts)
    assert small.shape == (2, 120, 160)
    assert small[0, 25, 50] == -2 and small[1, -1, -1] == 1 and np.count_nonzero(small) == 2
    assert np.array_equal(shrink_events(counts[:, :100, :150]), counts[:, :100, :150])
    assert shrink_events(np.zeros((1, 333, 500))).shape == (1, 107, 161)  # as of other panels


def test_panels_stand_side_by_side_under_their_names():
    left, right = ramp(2, 200, 200), ramp(2, 100, 60)
    frames = join_panels({"left": left, "right": right})
    assert frames.shape == (2, TITLE_PX + 200, 200 + GAP_PX + 120, 3)
    assert np.array_equal(frames[:, TITLE_PX:, :200], left)
    assert np.array_equal(frames[:, TITLE_PX::2, 200 + GAP_PX :: 2], right)
    assert (frames[:, :TITLE_PX, :200] < 0.5).any() and (frames[:, :, 200:204] == 1).all()


def test_small_panels_are_enlarged():
    assert join_panels({"small": ramp(1, 32, 32)}).shape[1] == TITLE_PX + 160


def test_pictures_are_enlarged_to_slopes_and_keep_their_range():
    edge = np.repeat([[[0.2] * 20 + [0.8] * 20]], 40, axis=1).astype(np.float32)
    large, small = (resize_pictures(edge, height)[0] for height in (160, 20))
    assert large.shape == (160, 160) and large.min() >= 0.2 and large.max() <= np.float32(0.8)
    between = (large > 0.3) & (large < 0.7)
    assert between[:, 76:84].any(1).all() and np.unique(small).size == 2


def test_grey_panels_are_interpolated_and_events_are_not():
    edge = np.repeat([[[0.0] * 20 + [1.0] * 20]], 40, axis=1).astype(np.float32)
    grey, events = (
        join_panels({"panel": panel})[0, TITLE_PX + 80, :, 0]
        for panel in (edge, np.repeat(edge[..., None], 3, -1))
    )
    assert len(np.unique(grey)) > 2 and np.unique(events).tolist() == [0, 1]


def test_a_title_too_long_for_its_panel_ends_before_the_colon():
    title = title_events(1 / 120)
    narrow, short = (
        join_panels({name: ramp(1, 160, 130)})[0, :TITLE_PX]
        for name in (title, "events of 8.33 ms")
    )
    wide = join_panels({title: ramp(1, 160, 400)})[0, :TITLE_PX]
    assert np.array_equal(narrow, short) and (wide[:, 120:] < 0.5).any()


def test_a_gif_keeps_frames_grey_levels_and_time(tmp_path):
    frames = ramp(4, 16, 24)
    write_animation(tmp_path / "a.gif", frames, fps=20.0)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.info["duration"]) == (4, 50)
        shown = np.stack([np.array(f.convert("RGB")) for f in ImageSequence.Iterator(image)])
    assert np.abs(shown / 255 - frames).max() < 0.02


@pytest.mark.parametrize(("suffix", "durations"), [("gif", {60, 70}), ("webp", {66, 67})])
def test_an_animation_has_the_rate_that_is_asked_in_the_mean(suffix, durations, tmp_path):
    path, shown = tmp_path / f"a.{suffix}", []
    write_animation(path, ramp(12, 16, 24), fps=15.0)
    with Image.open(path) as image:
        for frame in range(image.n_frames):
            image.seek(frame)
            image.load()
            shown.append(image.info["duration"])
    assert len(shown) == 12 and sum(shown) == 800 and set(shown) == durations
    write_animation(path, ramp(1, 16, 24), fps=15.0)
    write_animation(path, np.zeros((3, 16, 24)), fps=15.0)  # frames alike


def test_a_picture_is_the_first_frame(tmp_path):
    frames = ramp(2, 16, 24)
    write_animation(tmp_path / "a.png", frames, fps=20.0)
    with Image.open(tmp_path / "a.png") as image:
        assert np.array_equal(np.array(image), (frames[0] * 255 + 0.5).astype(np.uint8))


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.gif"
    write_animation(path, ramp(2, 16, 24), fps=20.0)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_animation(path, np.zeros((2, 16, 24, 7)), fps=20.0)
    assert path.read_bytes() == before
