"""Every format gives back the frames and their times, also of a run that was stopped."""

import csv
import inspect
import os

import cv2
import h5py
import numpy as np
import pytest
from PIL import Image

from src.recordings.files import videos
from src.recordings.output import open_video_writer, partial_path, write_video
from src.recordings.reconstruction import Frame

SIZE = (48, 64)


def frames(count: int = 5) -> list[Frame]:
    ramp = np.linspace(0, 0.8, SIZE[1], dtype=np.float32) * np.ones((SIZE[0], 1), np.float32)
    return [Frame(0.25 * k, ramp + 0.04 * k, 10 * k, k) for k in range(count)]


def video(path) -> np.ndarray:
    file, found = cv2.VideoCapture(str(path)), []
    while (read := file.read())[0]:
        found.append(read[1][..., 0])
    return np.stack(found)


def gif(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.stack([_seek(image, k) for k in range(image.n_frames)])


def _seek(image, k):
    image.seek(k)
    return np.asarray(image.convert("L"))


def png(folder) -> np.ndarray:
    return np.stack([cv2.imread(str(path), 0) for path in sorted(folder.glob("*.png"))])


def hdf5(path) -> np.ndarray:
    with h5py.File(path) as file:
        assert file["time_s"][:].tolist() == [0.25 * k for k in range(len(file["frames"]))]
        return file["frames"][:]


READERS = {
    "mp4": (video, "video.mp4", 6),
    "gif": (gif, "video.gif", 0),
    "png": (png, "frames", 0),
    "hdf5": (hdf5, "video.h5", 0),
}


@pytest.mark.parametrize("kind", READERS)
def test_frames_come_back(kind, tmp_path):
    with open_video_writer(kind, tmp_path, SIZE) as write:
        for frame in frames():
            write(frame)
    read, name, loss = READERS[kind]
    expected = np.stack([np.round(frame.picture * 255) for frame in frames()])
    assert np.abs(read(tmp_path / name).astype(float) - expected).max() <= loss + 1


@pytest.mark.parametrize("kind", READERS)
def test_what_was_done_is_kept_when_the_run_fails(kind, tmp_path):
    with (
        pytest.raises(ValueError, match="halfway"),
        open_video_writer(kind, tmp_path, SIZE) as write,
    ):
        for frame in frames(3):
            write(frame)
        raise ValueError("halfway")
    read, name, _ = READERS[kind]
    assert not (tmp_path / name).exists() and not (tmp_path / "frames.csv").exists()
    assert len(read(partial_path(tmp_path / name))) == 3
    with open(partial_path(tmp_path / "frames.csv")) as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time_s"]) for row in rows] == [0, 0.25, 0.5]
    assert rows[2]["events"] == "20" and rows[2]["events_outside_views"] == "2"


@pytest.mark.parametrize("fps", [50, 30, 24, 0.1])
def test_a_gif_is_as_fast_as_is_asked(fps, tmp_path):
    with open_video_writer("gif", tmp_path, SIZE, fps) as write:
        for frame in frames(12):
            write(frame)
    with Image.open(tmp_path / "video.gif") as image:
        durations_ms = [_seek(image, k) is not None and image.info["duration"] for k in range(12)]
    assert abs(sum(durations_ms) - 12_000 / fps) <= 5 and np.ptp(durations_ms) <= 10


@pytest.mark.parametrize(
    "kind, playback, message",
    [
        ("avi", 30, "output"),
        ("mp4", 0, "playback"),
        ("gif", 60, r"playback_fps must be in \[0.1, 50\] for output_format=gif, got 60"),
    ],
)
def test_a_wrong_choice_is_refused(kind, playback, message, tmp_path):
    with (
        pytest.raises(ValueError, match=message),
        open_video_writer(kind, tmp_path, SIZE, playback),
    ):
        pass


def test_an_mp4_keeps_an_odd_size(tmp_path):
    ramp = np.linspace(0, 0.9, 61, dtype=np.float32) * np.ones((47, 1), np.float32)
    with open_video_writer("mp4", tmp_path, ramp.shape) as write:
        for number in range(3):
            write(Frame(number / 30, ramp, 1, 0))
    found = np.stack(list(videos.read_video(tmp_path / "video.mp4")))
    assert found.shape == (3, 47, 61) and np.abs(found - ramp).max() < 7 / 255
    assert video(tmp_path / "video.mp4").shape == (3, 47, 61)


@pytest.mark.parametrize("colours", [False, True])
def test_frames_of_your_own_are_a_video(colours, tmp_path):
    shown = [frame.picture for frame in frames()]
    if colours:
        shown = [np.stack([picture, 0 * picture + 0.5, 1 - picture], -1) for picture in shown]
    assert write_video(tmp_path / "a.mp4", iter(shown), fps=25) == 5
    file = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    read = np.stack([file.read()[1][..., ::-1] for _ in range(5)]) / 255  # RGB
    wanted = np.stack(shown) if colours else np.stack(shown)[..., None].repeat(3, -1)
    assert file.get(cv2.CAP_PROP_FPS) == 25 and np.abs(read - wanted).mean() < 0.02
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize(
    "name, shapes, fps, message",
    [
        ("a.avi", [(16, 16)], 30, "path must end in .mp4, got"),
        ("a.mp4", [], 30, "frames must be of shape .* got none"),
        ("a.mp4", [(16, 16, 2)], 30, "frames must be of shape"),
        ("a.mp4", [(16, 16), (16, 18)], 30, "frames must be of one size"),
        ("a.mp4", [(16, 16)], 0, r"fps must be in \[0.1, 1000\], got 0"),
    ],
)
def test_no_video_of_wrong_frames(name, shapes, fps, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / name, [np.zeros(shape) for shape in shapes], fps)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "frame", [np.full(SIZE, 60, np.int64), np.full(SIZE, 60.0), np.full(SIZE, np.nan)]
)
def test_values_that_are_no_code_values_are_refused(frame, tmp_path):
    with pytest.raises(ValueError, match=r"frames must be uint8 or floats in \[-0.5, 1.5\], got"):
        write_video(tmp_path / "a.mp4", [frame], 30)
    assert not (tmp_path / "a.mp4").exists()


def test_two_processes_that_write_one_video_keep_apart(tmp_path):
    names = []

    def pictures():
        yield np.zeros(SIZE)
        names.extend(path.name for path in tmp_path.iterdir())

    write_video(tmp_path / "a.mp4", pictures(), 30)
    assert len(names) == 1 and f".{os.getpid()}." in names[0]


def test_what_no_video_can_be_written_of_is_named(tmp_path):
    write, frame = inspect.unwrap(write_video), np.zeros(SIZE)  # without the type checks of tests
    masked = np.ma.masked_array(frame, True)
    for given, message in (
        ((None, [frame], 30), "path must be a path, got a NoneType"),
        ((tmp_path / "a.mp4", [frame], "30"), "fps must be a number, got '30'"),
        ((tmp_path / "a.mp4", [masked], 30), "frames must be without a mask, got a masked array"),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            write(*given)


def test_a_folder_of_other_frames_is_not_deleted(tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "camera_0001.txt").write_text("mine")
    own = "output_format=png needs a folder frames/ of its own"
    with pytest.raises(ValueError, match=own), open_video_writer("png", tmp_path, SIZE):
        pass
    assert (tmp_path / "frames" / "camera_0001.txt").read_text() == "mine"


def test_pictures_are_read_in_the_order_of_their_numbers(tmp_path):
    for k in (1, 2, 10):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((8, 8), 10 * k, np.uint8))
    greys = [round(float(frame.mean()) * 255) for frame in videos.read_video(tmp_path)]
    assert greys == [10, 20, 100]
