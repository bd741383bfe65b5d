"""A user's own video and photograph: every frame, uncropped, at the rate of the file."""

import math
import re
import warnings
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from src.sim.scenes import user_clip

LEVELS = np.arange(10, 250, 20)  # of twelve frames


def write_film(path: Path, levels=LEVELS, size=(36, 64), fps=30) -> Path:
    """Write a lossless video of flat frames, a white stripe at the left edge."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("ffv1", rate=fps)
        stream.height, stream.width, stream.pix_fmt = *size, "gray"
        for level in levels:
            picture = np.full(size, level, np.uint8)
            picture[:, :4] = 255
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray")))
        file.mux(stream.encode())
    return path


def test_all_frames_of_a_video_are_there_uncropped_at_its_rate(tmp_path):
    clip = user_clip.read_video(write_film(tmp_path / "a.mkv"))
    assert clip.frames.shape == (12, 36, 64) and clip.fps == 30
    codes = np.round(clip.frames.astype(float) * 255)
    assert (codes[:, :, 4:] == LEVELS[:, None, None]).all() and (codes[:, :, :4] == 255).all()
    assert clip.source == "64x36 px, 30 frames/s, all of 12 frames"


def test_a_part_and_another_rate(tmp_path):
    path = write_film(tmp_path / "a.mkv")
    clip = user_clip.read_video(path, fps=120, start_s=2 / 120, end_s=5 / 120)
    assert clip.fps == 120 and np.round(clip.frames[:, 0, 9] * 255).tolist() == [50, 70, 90]
    assert clip.source.endswith("frames 2 to 4 of 12 frames")


def test_between_two_frames_lies_their_blend(tmp_path):
    clip = user_clip.read_video(write_film(tmp_path / "a.mkv"))
    seen = clip.interpolate_frames(3, 9, 4)[:, 0, 9].numpy() * 255
    assert np.allclose(seen, [25, 30, 35, 40, 45, 50], atol=0.05)
    assert len(clip.interpolate_frames(40, 45, 4)) == 5  # up to the last frame


def test_a_large_picture_is_shrunk_and_keeps_its_proportions(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((600, 1200), 100, np.uint8))
    clip = user_clip.read_photograph(tmp_path / "a.png", seconds=0.1)
    assert clip.frames.shape == (13, 256, 512) and clip.fps == 120
    assert np.allclose(clip.frames, 100 / 255)


def test_a_photograph_moves_when_asked_to_and_starts_as_it_is(tmp_path):
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (64, 96)).astype(np.float32), (0, 0), 3)
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    still, moving = (
        user_clip.read_photograph(tmp_path / "a.png", seconds=0.2, speed_widths_per_s=speed)
        for speed in (0.0, 0.5)
    )
    assert (still.frames == still.frames[0]).all()
    assert np.abs(moving.frames[0] - still.frames[0]).max() < 0.01
    assert np.abs(moving.frames[-1] - still.frames[0]).mean() > 0.01


def test_a_part_of_an_array_is_that_of_a_video():
    frames = np.repeat(np.arange(60, dtype=np.uint8), 48 * 64).reshape(60, 48, 64)
    clip = user_clip.clip_from_array(frames, fps=120.0, start_s=0.1, end_s=0.2)
    assert np.round(clip.frames[:, 0, 0] * 255).tolist() == list(range(12, 24))
    with pytest.raises(ValueError, match=r"must leave two frames or more of the array, 0.500 s"):
        user_clip.clip_from_array(frames, fps=120.0, start_s=99.0)
    with pytest.raises(ValueError, match="start_s and end_s are of a video, a photograph has sec"):
        user_clip.clip_from_array(frames[0], end_s=0.1)
    for only, value in (("seconds", 0.1), ("speed_widths_per_s", 0.3)):
        with pytest.raises(
            ValueError, match=f"{only} must be .* but for a photograph.* got {value}"
        ):
            user_clip.clip_from_array(frames, fps=120.0, **{only: value})
    with pytest.raises(ValueError, match="grey"):
        user_clip.clip_from_array(np.zeros((48, 64, 3), np.uint8), fps=60.0)
    with pytest.raises(ValueError, match=r"two frames or more, grey, got \(1, 48, 64\)$"):
        user_clip.clip_from_array(frames[:1], fps=60.0)


def test_arrays_are_clips(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (3, 20, 30), dtype=np.uint8)
    clip = user_clip.clip_from_array(frames, fps=50)
    assert (np.round(clip.frames * 255) == frames).all() and clip.fps == 50
    assert user_clip.clip_from_array(frames[0] / 255.0).frames.shape == (121, 20, 30)


@pytest.mark.parametrize("white, shown", [(None, 0.0625), (4095, 1.0), (8190, 0.5)])
def test_16_bits_are_kept_and_white_is_what_is_given(tmp_path, white, shown):
    picture = np.repeat(np.arange(0, 4096, 65, dtype=np.uint16)[None], 20, axis=0)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        still = user_clip.read_photograph(tmp_path / "0.png", seconds=0.1, white_level=white)
        film = user_clip.read_video(tmp_path, fps=120, white_level=white)
    wanted = np.minimum(picture[0] / (white or 65535), 1)
    assert np.allclose(still.frames[5, 0], wanted, atol=1e-6)  # not the 16 levels of 8 bits
    assert (
        np.allclose(film.frames[2, 0], wanted, atol=5e-4) and abs(still.frames.max() - shown) < 1e-4
    )
    told = "its largest value is 4095 of 65535; white_level=4095 makes 4095 white"
    assert [told in str(one.message) for one in caught] == [True] * (2 if white is None else 0)


def test_a_grey_video_of_16_bits_keeps_them(tmp_path):
    picture = np.repeat(np.arange(0, 4096, 65, dtype=np.uint16)[None], 20, axis=0)
    with av.open(str(tmp_path / "a.mkv"), "w") as file:
        stream = file.add_stream("ffv1", rate=30)
        stream.height, stream.width, stream.pix_fmt = *picture.shape, "gray16le"
        for _ in range(3):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray16le")))
        file.mux(stream.encode())
    with pytest.warns(UserWarning, match="largest value is 4095 of 65535; white_level=4095"):
        dark = user_clip.read_video(tmp_path / "a.mkv").frames
    bright = user_clip.read_video(tmp_path / "a.mkv", white_level=4095).frames
    assert np.allclose(dark, picture / 65535, atol=5e-4)
    assert np.allclose(bright, picture / 4095, atol=5e-4)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (np.zeros((20, 30), np.uint16), "frames of one kind, got uint8 and uint16 in .*1.png"),
        (np.full((20, 30), 2, np.float32), r"floats in \[0, 1\], got 2 to 2 in .*1.tiff"),
        (np.full((20, 30), np.nan, np.float32), r"floats in \[0, 1\], got nan to nan in .*1.tiff"),
    ],
)
def test_frames_of_other_values_are_refused_with_their_file(tmp_path, second, message):
    first = np.zeros((20, 30), np.uint8 if second.dtype == np.uint16 else np.float32)
    suffix = ".png" if second.dtype == np.uint16 else ".tiff"
    for number, picture in enumerate((first, second)):
        cv2.imwrite(str(tmp_path / f"{number}{suffix}"), picture)
    with pytest.raises(ValueError, match=f"^video must hold .*{message}"):
        user_clip.read_video(tmp_path, fps=30)
    if second.dtype == np.float32:
        with pytest.raises(ValueError, match=f"^photo must hold .*{message}"):
            user_clip.read_photograph(tmp_path / "1.tiff")


def test_transparent_pixels_are_told(tmp_path):
    picture = np.full((20, 30, 4), 255, np.uint8)
    cv2.imwrite(str(tmp_path / "1.png"), picture)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        user_clip.read_photograph(tmp_path / "1.png", seconds=0.1)  # all of it is opaque
    picture[5, 5, 3] = 0
    cv2.imwrite(str(tmp_path / "1.png"), picture)
    cv2.imwrite(str(tmp_path / "2.png"), picture)
    with pytest.warns(UserWarning, match="1.png: transparent pixels show hidden colours"):
        user_clip.read_photograph(tmp_path / "1.png", seconds=0.1)
    with pytest.warns(UserWarning, match="1.png: transparent pixels show hidden colours"):
        user_clip.read_video(tmp_path, fps=30)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda p: user_clip.read_video(p / "none.mp4"), "video must be a file or a folder"),
        (lambda p: user_clip.read_video(p / "a.png"), "a photograph is photo="),
        (lambda p: user_clip.read_video(p), "fps must be given, frames a second"),
        (lambda p: user_clip.read_video(p / "a.mkv", fps=-1), r"fps must be in \[0.1, 1e6\]"),
        (lambda p: user_clip.read_video(p / "a.mkv", end_s=0.03), "start_s and end_s must"),
        (lambda p: user_clip.read_video(p / "a.mkv", start_s=2, end_s=1), "start_s must be"),
        (lambda p: user_clip.read_video(p / "a.mkv", longest_side_px=8), "longest_side_px must"),
        (lambda p: user_clip.read_photograph(p / "a.mkv"), r"a film: video=\)"),
        (lambda p: user_clip.read_video(p / "a.mkv", white_level=9), "must be null for a video"),
        (
            lambda p: user_clip.read_photograph(p / "a.png", white_level=256),
            r"white_level must be in \(0, 255\] or null, got 256",
        ),
        (
            lambda p: user_clip.read_photograph(p / "a.png", white_level=0),
            r"white_level must be in \(0, 255\] or null, got 0",
        ),
        (lambda p: user_clip.clip_from_array(np.zeros((3, 20, 30))), "fps must be given"),
        (lambda p: user_clip.clip_from_array(np.full((20, 30), 7.0)), r"\[0, 1\], .*from 7 to 7"),
        (lambda p: user_clip.clip_from_array(np.zeros((20, 30), int)), r"\[0, 1\], got int64"),
        (lambda p: user_clip._check_rate("30"), r"fps must be in .* got 30"),
        (lambda p: user_clip._find_part(9, 30, "0", 1.0, "a.mkv"), "start_s must be .* got 0 and"),
        (lambda p: user_clip._find_part(9, 30, 0.0, None, "a.mkv"), "start_s must be .* and None"),
        (lambda p: user_clip.read_video(p / "one", fps=30), "two frames or more, got one in .*one"),
        (lambda p: user_clip.clip_from_array(np.zeros((1, 1, 2, 3))), "must be of shape"),
    ],
)
def test_wrong_material_is_one_line(call, message, tmp_path):
    write_film(tmp_path / "a.mkv")
    (tmp_path / "one").mkdir()
    for name in ("a.png", "b.png", "one/a.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((20, 30), np.uint8))
    with pytest.raises(ValueError, match=message) as error:
        call(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("key", "allowed", "value"),
    [("seconds", "[0.016667, 1e+06]", wrong) for wrong in (0, 0.01, 1e30, math.inf, math.nan)]
    + [("speed_widths_per_s", "[0, 100]", wrong) for wrong in (-1, 1e30, math.inf, math.nan)],
)
def test_numbers_of_a_photograph_outside_their_range_are_named(key, allowed, value, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((20, 30), np.uint8))
    with pytest.raises(ValueError, match=re.escape(f"{key} must be in {allowed}, got {value}")):
        user_clip.read_photograph(tmp_path / "a.png", **{key: value})
