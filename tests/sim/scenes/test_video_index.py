"""Videos as they come: edit lists, no duration, uneven times, cuts; any frame by number."""

import struct
import warnings
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from src.recordings.files import videos
from src.sim.scenes.footage import Footage
from src.sim.scenes.video_index import index_video

COUNT, SIZE = 40, (48, 64)
KINDS = {
    "h264.mp4": "libx264", "h264.ts": "libx264", "h264.mkv": "libx264", "vp9.webm": "libvpx-vp9",
    "vp8.webm": "libvpx", "mpeg4.avi": "mpeg4", "mjpeg.avi": "mjpeg", "mpeg4.mov": "mpeg4",
}  # fmt: skip


def picture(number: int) -> np.ndarray:
    """A picture whose grey level, without its texture, is 5 times its number."""
    return np.uint8(5 * number) + (np.indices(SIZE).sum(0) // 8 % 2 * 20).astype(np.uint8)


def write_video(path, times_s=None, codec=None, **container):
    """Write the pictures 0, 1, ..., at 30 a second or at `times_s`, a key frame every 12."""
    codec = codec or KINDS.get(path.name, "libx264")
    with av.open(str(path), "w", **container) as file:
        stream = file.add_stream(codec, rate=30)
        stream.height, stream.width = SIZE
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.gop_size, stream.bit_rate = 12, 4_000_000
        tick = Fraction(1, 30 if times_s is None else 1000)
        stream.codec_context.time_base = tick
        for number in range(COUNT):
            frame = av.VideoFrame.from_ndarray(picture(number), format="gray")
            frame.pts = number if times_s is None else round(1000 * times_s[number])
            frame.time_base = tick
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def numbers(frames) -> list[int]:
    """The numbers of the pictures that frames show."""
    return [round((float(frame.mean()) - 10) / 5) for frame in frames]


def read_with_opencv(path) -> list[np.ndarray]:
    file, found = cv2.VideoCapture(str(path)), []
    while (read := file.read())[0]:
        found.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    return found


@pytest.mark.parametrize("name", KINDS)
def test_frames_by_number_are_those_in_order_and_those_of_opencv(tmp_path, name):
    index = index_video(write_video(tmp_path / name), "video")
    frames = list(index.read(0, COUNT, "video"))
    assert numbers(frames) == list(range(COUNT)) and index.fps == pytest.approx(30)
    assert np.array_equal(frames, read_with_opencv(tmp_path / name))
    for first in (0, 5, 12, 13, 30, COUNT - 2):
        assert np.array_equal(
            list(index.read(first, first + 2, "video")), frames[first : first + 2]
        )


def turn(path, matrix: tuple[int, ...]) -> None:
    content = bytearray(path.read_bytes())
    start = content.index(b"tkhd") + 44  # ISO 14496-12, 8.3.2: version 0
    content[start : start + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(content)


def test_a_phone_held_upright_shows_upright_pictures(tmp_path):
    path = write_video(tmp_path / "h264.mp4")
    turn(path, (0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30))
    frames = list(index_video(path, "video").read(0, 2, "video"))
    assert frames[0].shape == SIZE[::-1] and np.array_equal(frames, read_with_opencv(path)[:2])


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((1, 0, 0, 1), lambda stored: stored),
        ((-1, 0, 0, -1), lambda stored: stored[::-1, ::-1]),
        ((-1, 0, 0, 1), np.fliplr),
        ((1, 0, 0, -1), np.flipud),
        ((0, 1, -1, 0), lambda stored: np.rot90(stored, -1)),
        ((0, -1, 1, 0), np.rot90),
        ((0, 1, 1, 0), np.transpose),
        ((0, -1, -1, 0), lambda stored: stored[::-1, ::-1].T),
    ],
)
def test_mirrored_and_turned_videos_are_shown_as_their_file_says(tmp_path, matrix, shown):
    """A point (x, y) is shown at (a x + c y, b x + d y): ISO 14496-12, 6.2.2."""
    path = write_video(tmp_path / "h264.mp4")
    (stored,) = index_video(path, "video").read(9, 10, "video")
    a, b, c, d = (entry * 65536 for entry in matrix)
    turn(path, (a, b, 0, c, d, 0, 0, 0, 1 << 30))
    (seen,) = index_video(path, "video").read(9, 10, "video")
    assert len({stored.tobytes(), *(one(stored).tobytes() for one in (np.fliplr, np.flipud))}) == 3
    assert np.array_equal(seen, shown(stored))


def test_an_uneven_rate_is_made_even_by_the_time_stamps_and_said(tmp_path):
    gaps = np.where(np.arange(COUNT - 1) % 10 == 9, 0.12, 0.04)
    times = np.concatenate([[0], np.cumsum(gaps)])
    path = write_video(tmp_path / "phone.mp4", times)
    with pytest.warns(UserWarning, match="40 frames are brought to 25 frames/s by their time"):
        index = index_video(path, "video")
    nearest = [int(np.abs(times - k / 25).argmin()) for k in range(46)]
    assert (
        numbers(index.read(0, 99, "video"))[::3] == nearest[::3]
        and len(index.constant_rate_frames) == 46
    )
    assert numbers(index.read(11, 13, "video")) == nearest[11:13]
    for kind, times_said in (("always", 3), ("default", 1)):  # of Python's own: once a process
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter(kind)
            assert videos.read_fps(path) == videos.read_fps(path, "recording") == 25
            index_video(path, "video")
        assert len(caught) == times_said


def test_a_time_base_too_coarse_for_the_rate_is_no_uneven_rate(tmp_path):
    path = write_video(tmp_path / "fast.mkv", np.arange(COUNT) / 600)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        index = index_video(path, "video")
    assert numbers(index.read(0, COUNT, "video")) == list(range(COUNT))
    assert index.fps == pytest.approx(600, rel=0.01)


CUTS = [
    ("cut.mp4", {"container_options": {"movflags": "faststart"}}),
    ("cut.mkv", {}),
    ("mpeg4.avi", {}),
]


@pytest.mark.parametrize(("name", "options"), CUTS)
def test_of_a_cut_video_the_whole_frames_are_read_and_counted(tmp_path, name, options):
    path = write_video(tmp_path / name, **options)
    path.write_bytes(path.read_bytes()[: int(0.75 * path.stat().st_size)])
    with pytest.warns(UserWarning, match="is cut or damaged .* its first .. frames are read"):
        scene = Footage(str(path), height=48, width=64, frames=4, disjoint_splits=False)
    count = scene.segments[0][0].count
    assert 12 <= count < COUNT
    assert numbers(scene.segments[0][0].read(0, count)) == list(range(count))


def test_damage_in_the_middle_is_found_before_the_first_clip(tmp_path):
    path = write_video(tmp_path / "h264.mp4")
    content = bytearray(path.read_bytes())
    start = content.index(b"mdat") + (len(content) - content.index(b"mdat")) // 3
    content[start : start + 200] = bytes(range(200))
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="cut or damaged"):
        index = index_video(path, "video")
    frames = list(index.read(0, len(index.constant_rate_frames), "video"))
    assert 2 <= len(frames) < COUNT and numbers(frames) == list(range(len(frames)))


def test_a_file_without_a_picture_is_refused(tmp_path):
    path = write_video(tmp_path / "cut.mp4")
    path.write_bytes(path.read_bytes()[:-200])  # its table of contents is at the end
    with pytest.raises(ValueError, match="^video must be a video that FFmpeg can read"):
        index_video(path, "video")
    with pytest.raises(ValueError, match="^video must be a video that exists"):
        index_video(tmp_path / "none.mp4", "video")


def test_text_is_no_film(tmp_path):
    """FFmpeg would draw the letters of a list of events."""
    path = tmp_path / "events.txt"
    path.write_text("0.000450 60 134 1\n" * 2000)
    with pytest.raises(ValueError, match="^video must be a video that FFmpeg can read"):
        index_video(path, "video")


def test_names_that_ffmpeg_takes_for_addresses_are_files(tmp_path):
    path = write_video(tmp_path / "http: größe %03d.mp4")
    assert len(index_video(path, "video").constant_rate_frames) == COUNT


@pytest.mark.parametrize(
    ("name", "count", "fps"),
    [("browser_no_duration.webm", 120, 30), ("trimmed_edit_list.mp4", 105, 30)],
)
def test_reported_files_show_all_their_frames(shared_data, name, count, fps):
    index = index_video(shared_data / "reported" / name, "video")
    frames = list(index.read(0, count, "video"))
    assert len(index.constant_rate_frames) == len(frames) == count and index.fps == pytest.approx(
        fps
    )
    assert np.array_equal(list(index.read(77, 79, "video")), frames[77:79])
