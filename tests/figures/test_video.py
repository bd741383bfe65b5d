"""Pictures that move: what is written is what was shown, whole or not at all."""

import numpy as np
import pytest
from PIL import Image, ImageSequence

from src.figures.samples import GAP_PX, TITLE_PX, join_panels, render_events, write_video


def ramp(frames: int, height: int, width: int) -> np.ndarray:
    grey = np.arange(frames * height * width).reshape(frames, height, width, 1) % 11 / 10
    return np.repeat(grey, 3, axis=-1).astype(np.float32)


def test_events_are_blue_on_and_red_off_on_white():
    off, none, on = render_events(np.array([[[-3.0, 0.0, 3.0]]]))[0, 0]
    assert none.tolist() == [1, 1, 1]
    assert on.argmax() == 2 and off.argmax() == 0
    assert np.allclose(render_events(np.array([[[9.0]]]))[0, 0], on)


def test_fainter_events_are_paler():
    one, two, three = render_events(np.array([[[1.0, 2.0, 3.0]]]))[0, 0, :, 0]
    assert 1 > one > two > three


def test_panels_stand_side_by_side_under_their_names():
    left, right = ramp(2, 200, 200), ramp(2, 100, 60)
    frames = join_panels({"left": left, "right": right})
    assert frames.shape == (2, TITLE_PX + 200, 200 + GAP_PX + 120, 3)
    assert np.array_equal(frames[:, TITLE_PX:, :200], left)
    assert np.array_equal(frames[:, TITLE_PX::2, 200 + GAP_PX :: 2], right)
    assert (frames[:, :TITLE_PX, :200] < 0.5).any() and (frames[:, :, 200:204] == 1).all()


def test_small_panels_are_enlarged():
    assert join_panels({"small": ramp(1, 32, 32)}).shape[1] == TITLE_PX + 160


def test_a_gif_keeps_frames_grey_levels_and_time(tmp_path):
    frames = ramp(4, 16, 24)
    write_video(tmp_path / "a.gif", frames, fps=20.0)
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.info["duration"]) == (4, 50)
        shown = np.stack([np.array(f.convert("RGB")) for f in ImageSequence.Iterator(image)])
    assert np.abs(shown / 255 - frames).max() < 0.02


def test_a_picture_is_the_first_frame(tmp_path):
    frames = ramp(2, 16, 24)
    write_video(tmp_path / "a.png", frames, fps=20.0)
    with Image.open(tmp_path / "a.png") as image:
        assert np.array_equal(np.array(image), (frames[0] * 255 + 0.5).astype(np.uint8))


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.gif"
    write_video(path, ramp(2, 16, 24), fps=20.0)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_video(path, np.zeros((2, 16, 24, 7)), fps=20.0)
    assert path.read_bytes() == before
