"""Recordings with frames: read from each data set's layout, written in EVREAL's."""

import json
import warnings

import cv2
import h5py
import numpy as np
import pytest

from src.recordings.files import read_events, recording_inputs
from src.recordings.files.recorded_frames import find_frames
from src.recordings.files.recording import open_recording
from tests.recordings.files.frames import (
    FRAME_US,
    LAYOUTS,
    SIZE,
    START_US,
    make_events,
    make_frames,
    write_recording,
)
from tests.test_convert import convert  # noqa: F401 - a fixture

pytestmark = pytest.mark.filterwarnings("ignore:.*a sensor of 48x40, as its frames")


@pytest.fixture(params=LAYOUTS)
def written(tmp_path, request):
    """Return a recording of each layout, its events and its frames."""
    events, frames = make_events(), make_frames()
    path = write_recording(tmp_path / "cap", request.param, events, frames)
    zero = START_US if request.param == "evreal" else 0
    return path, events, frames, zero


def test_events_and_frames_of_each_layout(written):
    path, events, frames, zero = written
    assert recording_inputs.find_sensor_size(path) == SIZE
    found = read_events(path, sensor_size=SIZE)
    assert np.array_equal(found["t"], events["t"] - zero)
    for name in "xyp":
        assert np.array_equal(found[name], events[name]), name
    counts = recording_inputs.read_picture_or_event_counts(path)  # as src.calibrate reads it
    assert counts.shape == SIZE and counts.sum() == len(events)
    beside = find_frames(open_recording(path))
    assert beside.size == SIZE
    assert np.allclose(beside.times_us, FRAME_US - zero, rtol=0, atol=0.01)
    for _ in range(2):  # as often as wanted
        assert np.array_equal(np.stack(list(beside.pictures())), frames)


@pytest.mark.parametrize("ending", ["h5", "hdf5"])
def test_of_events_and_an_array_of_frames_the_events_are_read(tmp_path, ending):
    path, events = tmp_path / f"cap.{ending}", make_events()
    with h5py.File(path, "w") as file:
        file.create_group("events").update({name: events[name] for name in "txyp"})
        file["frames"] = make_frames()
    with pytest.warns(
        UserWarning, match=f"cap.{ending} holds events and frames: its events are used"
    ):
        counts = recording_inputs.read_picture_or_event_counts(path, SIZE)
    assert counts.sum() == len(events)
    with h5py.File(path, "a") as file:
        del file["events"]
    assert recording_inputs.has_events(path) == (ending == "hdf5")  # a film ends in .h5


def test_each_layout_becomes_evreals(written, tmp_path, convert):  # noqa: F811
    path, events, frames, _ = written
    convert(f"recording={path}", f"out={tmp_path}/out", "layout=evreal")
    held = {file.stem: np.load(file) for file in (tmp_path / "out").glob("*.npy")}
    assert np.allclose(held["events_ts"], (events["t"] - START_US) * 1e-6, rtol=0, atol=1e-9)
    assert np.array_equal(held["events_xy"], np.stack([events["x"], events["y"]], 1))
    assert np.array_equal(held["events_p"], events["p"] > 0)
    # The last frame is the first after the events.
    assert np.array_equal(held["images"], frames[..., None]) and held["images"].dtype == np.uint8
    assert np.allclose(held["images_ts"], (FRAME_US[:, None] - START_US) * 1e-6, rtol=0, atol=1e-8)
    last = [max(0, int((events["t"] <= time).sum()) - 1) for time in FRAME_US]
    assert held["image_event_indices"].tolist() == [[k] for k in last]
    assert json.loads((tmp_path / "out/metadata.json").read_text())["sensor_resolution"] == [*SIZE]


def test_a_sensors_size_from_frames_is_told(tmp_path):
    path = write_recording(tmp_path / "cap", "timelens", make_events(), make_frames())
    with pytest.warns(UserWarning, match="a sensor of 48x40, as its frames"):
        assert recording_inputs.find_sensor_size(path) == SIZE
    assert recording_inputs.find_sensor_size(path, (60, 70)) == (60, 70)


def test_a_part_has_the_frames_of_its_time(tmp_path, convert):  # noqa: F811
    events = make_events()
    path = write_recording(tmp_path / "cap", "timelens", events, make_frames())
    start = int(events["t"][0])
    given = (f"recording={path}", f"out={tmp_path}/out", "layout=evreal")
    with pytest.warns(UserWarning, match="1 of 4 frames come after the last event, left out"):
        convert(*given, "start_s=0.01", "end_s=0.06")
    part = events[(events["t"] >= start + 10_000) & (events["t"] < start + 60_000)]
    zero, kept = part["t"][0], FRAME_US[1:4]
    assert np.allclose(np.load(tmp_path / "out/events_ts.npy"), (part["t"] - zero) * 1e-6)
    assert np.allclose(np.load(tmp_path / "out/images_ts.npy")[:, 0], (kept - zero) * 1e-6)
    assert np.array_equal(np.load(tmp_path / "out/images.npy")[..., 0], make_frames()[1:4])


def test_frames_of_another_size_are_left_out_with_a_word(tmp_path, convert):  # noqa: F811
    path = write_recording(tmp_path / "cap", "timelens", make_events(), make_frames())
    given = (f"recording={path}", f"out={tmp_path}/out", "layout=evreal", "sensor_size=[60,70]")
    with pytest.warns(UserWarning, match="frames of 48x40 are left out, the sensor is 70x60"):
        convert(*given)
    assert not (tmp_path / "out/images.npy").exists()
    assert len(np.load(tmp_path / "out/events_ts.npy")) == 3000


def test_pictures_without_times_are_left_out_with_a_word(tmp_path):
    path = write_recording(tmp_path / "cap", "timelens", make_events(), make_frames())
    (path / "images/timestamp.txt").unlink()
    with pytest.warns(UserWarning, match=r"5 frames without timestamp\.txt, left out"):
        assert find_frames(open_recording(path, SIZE)) is None


def test_hidden_files_are_no_pictures(tmp_path):
    path = write_recording(tmp_path / "cap", "timelens", make_events(), make_frames())
    (path / "images/._frame1.png").write_bytes(b"\0\5\x16\7")  # as macOS leaves beside one
    assert np.array_equal(find_frames(open_recording(path)).times_us, FRAME_US)


def test_a_time_that_is_wrong_lies_between_its_neighbours(tmp_path):
    path = write_recording(tmp_path / "cap", "timelens", make_events(), make_frames())
    times = [*FRAME_US[:2], START_US + 10, *FRAME_US[3:]]
    np.savetxt(path / "images/timestamp.txt", times, "%d")
    with pytest.warns(UserWarning, match="1 frames earlier than the one before"):
        found = find_frames(open_recording(path))
    assert np.array_equal(found.times_us, FRAME_US)


def _wrong_count(path):
    (path / "images/timestamp.txt").write_text("1\n2\n")


def _wrong_size(path):
    cv2.imwrite(str(path / "images/frame10.png"), np.zeros((3, 4), np.uint8))


def _no_picture(path):
    (path / "images/frame8.png").write_bytes(b"none")


def _no_number(path):
    (path / "images/timestamp.txt").write_text("now\n")


def _backwards(path):
    np.savetxt(path / "images/timestamp.txt", FRAME_US[::-1], "%d")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_wrong_count, r"timestamp\.txt has 2 times for 5 pictures"),
        (_wrong_size, "frame 3 must have 8 bits and 48x40 pixels, as the first, got 4x3"),
        (_no_picture, r"frame8\.png must be a picture that can be read"),
        (_no_number, r"timestamp\.txt must have a time in each line"),
        (_backwards, "the times of its frames must ascend"),
    ],
)
def test_frames_that_cannot_be_read_are_named(tmp_path, spoil, words):
    path = write_recording(tmp_path / "cap", "timelens", make_events(), make_frames())
    spoil(path)
    with warnings.catch_warnings(), pytest.raises(ValueError, match=words) as error:
        warnings.simplefilter("ignore")
        list(find_frames(open_recording(path, SIZE)).pictures())
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"events_p": None}, r"events_p\.npy is missing"),
        ({"images_ts": None}, r"images_ts\.npy is missing"),
        ({"events_ts": None, "events_xy": None, "events_p": None}, r"events_ts\.npy is missing"),
        ({"events_ts": np.arange(3000)}, "must hold seconds as float64, got int64"),
        ({"events_xy": np.zeros((2, 3000))}, r"must be \(n, 2\) of whole numbers, got \(2, 3000\)"),
        ({"events_p": np.zeros(2999)}, r"3000 in events_ts\.npy, .*2999 in events_p\.npy"),
        ({"images_ts": np.zeros((4, 1))}, r"5 in images\.npy, 4 in images_ts\.npy, 5 in image_e"),
        (
            {"images": np.zeros((5, 40, 48), np.uint8)},
            r"images\.npy must be \(m, h, w, 1\) of uint8",
        ),
        (
            {"images": np.zeros((5, 4, 4, 1), np.uint8)},
            r"frames are \(4, 4\), metadata\.json states",
        ),
        ({"image_event_indices": np.full((5, 1), 3001)}, r"must hold numbers of events, 0\.\.3000"),
    ],
)
def test_what_is_no_sequence_of_evreal_is_named(tmp_path, change, words):
    path = write_recording(tmp_path / "cap", "evreal", make_events(), make_frames())
    for name, array in change.items():
        (path / f"{name}.npy").unlink()
        if array is not None:
            np.save(path / f"{name}.npy", array)
    with pytest.raises(ValueError, match=words) as error:
        open_recording(path)
    assert str(error.value).startswith(str(path))


def test_an_older_version_of_the_layout_is_named(tmp_path):
    for name in ("t", "xy", "p", "images", "timestamps"):
        np.save(tmp_path / f"{name}.npy", np.zeros(3))
    with pytest.raises(ValueError, match=r"t\.npy, xy\.npy, p\.npy are another version of the"):
        open_recording(tmp_path)
