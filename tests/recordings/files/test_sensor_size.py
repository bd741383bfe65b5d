"""Sensor sizes that are stated the wrong way round, by the user or not at all."""

import warnings

import h5py
import numpy as np
import pytest

from src.recordings.files import open_recording, read_events, recording_inputs
from src.recordings.files.sensor_size import check_sensor_size
from tests.recordings.files.bags import Bag
from tests.recordings.files.tables import write_events
from tests.recordings.files.test_recording import made_up


def write_swapped(folder, kind):
    """Write events of 640x480 that state 480x640; return their path."""
    events = made_up()
    if kind == "h5":
        with h5py.File(path := folder / "a.h5", "w") as file:
            for name in "txyp":
                file[f"events/{name}"] = events[name]
            file.attrs["size"] = (480, 640)
    elif kind == "bag":
        events["t"] *= 1000
        with Bag(path := folder / "a.bag", None) as bag:
            bag.add_array("/dvs/events", events, size=(640, 480))
    else:
        rows = "".join(f"{t} {x} {y} {p > 0:d}\n" for t, x, y, p in events.tolist())
        (path := folder / "a.txt").write_text(f"480 640\n{rows}")
    return path


@pytest.mark.parametrize("kind", ["h5", "bag", "txt"])
def test_sides_the_wrong_way_round_are_exchanged(tmp_path, kind):
    path = write_swapped(tmp_path, kind)
    line = r"states a sensor of 480x640, its events fit 640x480: read as sensor_size=\[480,640\]"
    for given in (None, (480, 640)):
        with pytest.warns(UserWarning, match=line):
            assert recording_inputs.find_sensor_size(path, given) == (480, 640)
    with pytest.warns(UserWarning, match=line):
        assert np.array_equal(read_events(path), made_up())


@pytest.mark.parametrize(("stated", "lines"), [((1280, 720), 1), ((720, 1280), 0), ((640, 640), 0)])
def test_the_larger_side_of_a_resolution_is_the_width(tmp_path, stated, lines):
    """Of events that fit either way."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = made_up()[name]
        file.attrs["resolution"] = stated
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = open_recording(tmp_path / "a.h5").size
    assert found == tuple(sorted(stated, reverse=True))
    assert ["resolution 1280, 720 is read as width, height" in str(one) for one in said] == (
        [True] * lines
    )


def test_the_users_size_comes_before_the_files(tmp_path):
    write_events(tmp_path / "a.raw", made_up(), width=640, height=480)
    line = r"states a sensor of 640x480: read as sensor_size=\[500,700\]"
    with pytest.warns(UserWarning, match=line):
        assert recording_inputs.find_sensor_size(tmp_path / "a.raw", [500, 700]) == (500, 700)
    with pytest.warns(UserWarning, match=line):
        assert open_recording(tmp_path / "a.raw", (500, 700)).size == (700, 500)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert recording_inputs.find_sensor_size(tmp_path / "a.raw", [480, 640]) == (480, 640)


@pytest.mark.parametrize(
    "wrong", [480, "480x640", (480.5, 640.0), (480, 640, 3), (0, 640), (8193, 640), ((1,), (2, 3))]
)
def test_a_size_that_is_none_is_refused(wrong):
    words = r"sensor_size must be \(height, width\), whole numbers in 1\.\.8192, got"
    with pytest.raises(ValueError, match=words):
        check_sensor_size(wrong)


@pytest.mark.parametrize("given", [(480, 8192), [480, 8192], np.array([480, 8192])])
def test_a_size_may_be_any_sequence(given):
    assert check_sensor_size(given) == (8192, 480)


def test_a_few_events_outside_exchange_nothing(tmp_path):
    events = made_up()
    events["x"], events["y"] = events["x"] % 300, events["y"] % 300
    events["x"][:10] = 400
    write_events(tmp_path / "a.npz", events, width=400, height=480)
    with pytest.warns(UserWarning, match=r"10 of 2000 events outside 400x480, dropped; all fit "):
        assert len(read_events(tmp_path / "a.npz")) == 1990


@pytest.mark.parametrize(("outside", "is_refused"), [(999, False), (1000, True)])
@pytest.mark.parametrize("ending", [".dat", ".npz"])
def test_half_of_the_events_off_the_sensor_are_refused(tmp_path, ending, outside, is_refused):
    events = made_up()
    events["x"], events["y"] = np.where(np.arange(2000) < outside, 500, 3), 7
    path = tmp_path / f"a{ending}"
    write_events(path, events, width=640, height=480)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not is_refused:
            assert len(read_events(path, sensor_size=(300, 400))) == 1001
            return
        words = "1000 of 2000 events are off the 400x300 sensor, they need 501x8; is sensor_size="
        with pytest.raises(ValueError, match=words):
            read_events(path, sensor_size=(300, 400))


def test_parts_of_a_pixel_without_frames_are_told_of(tmp_path):
    """BS-ERGB's 1/32: a folder, and one file of it."""
    n = np.arange(500)
    columns = {"x": n * 32, "y": n % 300 * 32, "timestamp": n * 100, "polarity": n % 2}
    np.savez(tmp_path / "000000.npz", **columns)
    for path in (tmp_path, tmp_path / "000000.npz"):
        with pytest.warns(UserWarning, match="up to 15968 and 9568, beyond any sensor; parts of"):
            read_events(path)


def test_the_former_size_is_refused_with_its_new_name(tmp_path):
    (tmp_path / "a.csv").write_text("t,x,y,p\n" + "".join(f"{n},{n},1,1\n" for n in range(9)))
    for wrong in ((480,), [480, 640, 1]):
        with pytest.raises(
            ValueError, match=r"sensor_size must be \(height, width\), whole .*, got"
        ):
            read_events(tmp_path / "a.csv", sensor_size=wrong)
    with pytest.raises(ValueError, match=r"is now sensor_size=\(height, width\), got \(640, 480\)"):
        read_events(tmp_path / "a.raw", size=(640, 480))
