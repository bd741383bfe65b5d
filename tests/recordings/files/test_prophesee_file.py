"""RAW and DAT: headers in any order, words put together here by the formats' own tables."""

from functools import partial

import evt3
import numpy as np
import pytest

from src.recordings.files import prophesee_file, read_events
from src.recordings.files.prophesee_file import PropheseeFile
from tests.recordings.files import raw_events
from tests.recordings.files.raw_events import equal
from tests.recordings.files.test_recording import made_up

DATE = "% date 2023-04-03 11:36:26\n"
read = partial(raw_events.read, PropheseeFile)


def evt2(events, high_first: bool = True) -> np.ndarray:
    """Return words (n,) uint32: high bits of time where they change, then the event."""
    words, high = [], None
    for t, x, y, p in events.tolist():
        if t >> 6 != high and (high_first or high is not None or t > events["t"][0] + 500):
            words.append(8 << 28 | (t >> 6) % 2**28)
            high = t >> 6
        words.append(int(p > 0) << 28 | (t & 63) << 22 | x << 11 | y)
    return np.array(words, np.uint32)


def evt21(events) -> np.ndarray:
    """Return words (n,) uint64, an event each or two in one."""
    words, high = [], None
    for t, x, y, p in events.tolist():
        if t >> 6 != high:
            high = t >> 6
            words.append(8 << 60 | (high % 2**28) << 32)
        word = int(p > 0) << 60 | (t & 63) << 54 | x // 32 * 32 << 43 | y << 32
        words.append(word | 1 << x % 32)
    return np.array(words, np.uint64)


def evt3_words(events) -> np.ndarray:
    """Return words (n,) uint16: each of a vector of 12 (even rows) or 8, or alone (row 0)."""
    words, last = [], None
    for t, x, y, p in events.tolist():
        if t >> 12 != last:
            last = t >> 12
            words.append(8 << 12 | last % 2**12)
        words += [6 << 12 | t % 2**12, y]
        on, width, kind = int(p > 0) << 11, *((12, 4) if y % 2 else (8, 5))
        if y:
            words += [3 << 12 | on | max(x - 20, 0), kind << 12, kind << 12]
            place = x - max(x - 20, 0)
            if place >= width:
                words[-1] |= 1 << place - width if place < 2 * width else 0
            else:
                words[-2] |= 1 << place
        if not y or (y and place >= 2 * width):
            words.append(2 << 12 | on | x)
    return np.array(words, np.uint16)


def dat(events, kind=12, version=2) -> bytes:
    bits = (9, 8) if version == 1 else (14, 14)
    table = np.empty((len(events), 2), np.uint32)
    table[:, 0] = events["t"] % 2**32
    table[:, 1] = events["x"] | events["y"].astype(np.uint32) << bits[0]
    table[:, 1] |= (events["p"] > 0).astype(np.uint32) << sum(bits)
    header = f"% Data file\n% Version {version}\n% Height 240\n% Width 320\n".encode()
    return header + bytes([kind, 8]) + table.tobytes()


@pytest.mark.parametrize(
    ("lines", "size"),
    [
        ("% evt 3.0\n% geometry 320x240\n", (320, 240)),
        ("% geometry 320x240\n% evt 3.0\n% end\n", (320, 240)),
        ("% format EVT3;height=240;width=320\n% end\n", (320, 240)),
        ("% format EVT3;width=320;height=240\n", (320, 240)),
        ("% Height 240\n% evt 3.0\n% Width 320\n", (320, 240)),
        ("% width 320\r\n% evt 3.0\r\n% height 240\r\n% end\r\n", (320, 240)),
        ("% evt 3.0\n% plugin_name hal_plugin_gen41_evk3\n", (1280, 720)),
        ("% evt 3.0\n% sensor_name IMX636\n% endianness little\n% end\n", (1280, 720)),
        ("% evt 3.0\n% plugin_name hal_plugin_gen3_fx3\n", (640, 480)),
        ("% evt 3.0\n% serial 7\n", None),
    ],
)
def test_headers_in_any_order(tmp_path, lines, size):
    events = made_up(50)
    content = (DATE + lines).encode() + evt3_words(events).tobytes()
    file, found = read(tmp_path / "a.raw", content)
    assert file.size == size and file.time_unit == "us" and equal(found, events)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("gen1_type0.dat", {}), ("height_first.dat", {}), ("format_line_only.raw", {}),
        ("old_header.raw", {"format": "evt2"}), ("UPPER.RAW", {}),
    ],
)  # fmt: skip
def test_reported_files_hold_the_scene_of_good_txt(shared_data, name, options):
    t, x, y, p = np.loadtxt(shared_data / "reported/good.txt", skiprows=1).T
    file, found = read(shared_data / "reported" / name, **options)
    assert file.size == ((640, 480) if options else (320, 240)) and len(found.t) == 1500
    assert np.array_equal(found.t, np.rint(t * 1e6)) and np.array_equal(found.p > 0, p > 0)
    assert np.array_equal(found.x, x) and np.array_equal(found.y, y)


def test_a_cameras_evt3_is_what_another_decoder_reads(shared_data):
    path = shared_data / "events/evk3_1280x720_evt3.raw"
    (_, ours), theirs = read(path), evt3.decode_file(str(path))
    assert len(ours.t) == 219_596
    for found, expected in ((ours.t, theirs.t), (ours.x, theirs.x), (ours.y, theirs.y)):
        assert np.array_equal(found, np.asarray(expected, np.int64))
    # The camera repeats TIME_LOW words that step back by up to 11 us; sorted, ours never go back.
    kept = read_events(path)
    assert np.array_equal(theirs.x, kept["x"]) and np.array_equal(theirs.y, kept["y"])
    ahead = kept["t"] - np.asarray(theirs.t, np.int64)
    assert ahead.min() >= 0 and ahead.max() <= 11 and (ahead > 0).mean() < 0.01


ENCODERS = {"evt2": evt2, "evt21": evt21, "evt3": evt3_words}


@pytest.mark.parametrize("kind", ENCODERS)
@pytest.mark.parametrize("start", [0, 2**24 - 5000, 2**34 - 5000])
@pytest.mark.parametrize("piece", [64, 2**18])
def test_words_go_on_from_block_to_block(tmp_path, monkeypatch, kind, start, piece):
    monkeypatch.setattr(prophesee_file, "PIECE_EVENTS", piece)
    events = made_up(400)
    events["t"] += start - events["t"][0]
    content = b"% geometry 640x480\n% end\n" + ENCODERS[kind](events).tobytes()
    _, found = read(tmp_path / "a.raw", content, format=kind)
    rounds = {"evt2": 2**34, "evt21": 2**34, "evt3": 2**24}[kind]
    events["t"] -= start // rounds * rounds
    assert equal(found, events)


@pytest.mark.parametrize("order", ["little", "legacy", "big"])
@pytest.mark.parametrize("header", ["% evt 2.1\n% end\n", "% format EVT21;endianness={};width=9\n"])
def test_evt21_in_any_order_of_bytes(tmp_path, order, header):
    events = made_up(400)
    words = evt21(events)
    words = words << 32 | words >> 32 if order == "legacy" else words
    words = words.byteswap() if order == "big" else words
    content = header.format(order).encode() + words.tobytes()
    assert equal(read(tmp_path / "a.raw", content)[1], events)


def test_a_word_of_evt21_holds_32_events(tmp_path):
    words = np.array(
        [8 << 60 | 3 << 32, 1 << 60 | 5 << 54 | 64 << 43 | 7 << 32 | 0x80000005], np.uint64
    )
    _, found = read(tmp_path / "a.raw", b"% evt 2.1\n" + words.tobytes())
    assert found.t.tolist() == [3 * 64 + 5] * 3 and found.x.tolist() == [64, 66, 95]
    assert found.y.tolist() == [7] * 3 and found.p.tolist() == [1] * 3


@pytest.mark.parametrize(("kind", "version"), [(0, 2), (12, 2), (0, 1), (12, 1)])
def test_dat_of_all_kinds(tmp_path, kind, version):
    events = made_up(400, width=304, height=240)
    events["t"] += 2**32 - events["t"][200]  # there the clock goes round
    file, found = read(tmp_path / "a.dat", dat(events, kind, version))
    assert file.size == (320, 240) and equal(found, events)


@pytest.mark.parametrize("size", ["", "% Height 240\n% Width 304\n"])
def test_a_dat_without_a_version_is_of_the_first_atis(tmp_path, size):
    events = made_up(400, width=304, height=240)
    events["t"] += 2**32 - events["t"][200]
    body = dat(events, 0, version=1).partition(b"% Width 320\n")[2]
    head = f"% Data file containing TD events.\n% Date 2014-01-01 10:11:12\n{size}"
    file, found = read(tmp_path / "a_td.dat", head.encode() + body)
    assert file.size == (304, 240) and equal(found, events)


@pytest.mark.parametrize("size", ["", "% Height 240\n% Width 304\n"])
def test_a_dat_without_a_version_may_be_of_a_later_camera(tmp_path, size):
    events = made_up(400, width=304, height=240)
    body = dat(events, 0, version=2).partition(b"% Width 320\n")[2]
    (tmp_path / "a.dat").write_bytes(f"% dat_version 2\n{size}".encode() + body)
    _, found = read(tmp_path / "a.dat", (tmp_path / "a.dat").read_bytes())
    assert equal(found, events)


def test_what_is_dropped_or_cut_is_counted(tmp_path):
    events = made_up(400)
    content = b"% evt 2.0\n" + evt2(events, high_first=False).tobytes()
    lost = int((events["t"] <= events["t"][0] + 500).sum())
    with pytest.warns(UserWarning, match=f"a.raw: {lost} events before the first time, dropped"):
        assert equal(read(tmp_path / "a.raw", content)[1], events[lost:])
    for name, content in (
        ("a.raw", b"% evt 2.0\n" + evt2(events).tobytes()),
        ("a.dat", dat(events)),
    ):
        with pytest.warns(UserWarning, match="ends within an event, it is truncated"):
            assert equal(read(tmp_path / name, content[:-3])[1], events[:-1])


@pytest.mark.parametrize(("said", "held"), [("2.0", "evt3"), ("3.0", "evt2")])
def test_words_of_another_format_than_the_header_says_are_told_apart(tmp_path, said, held):
    events = made_up(400)
    content = f"% evt {said}\n".encode() + ENCODERS[held](events).tobytes()
    for options in ({}, {"format": f"evt{said[0]}"}):
        file, found = read(tmp_path / "a.raw", content, **options)
        assert equal(found, events)
        assert file.notes[0].endswith(f"states EVT{said[0]}, its words are EVT{held[3]}: read as "
                                      f"EVT{held[3]}")  # fmt: skip
    content = f"% evt {held[3]}.0\n".encode() + ENCODERS[held](events).tobytes()
    assert read(tmp_path / "b.raw", content)[0].notes == ()


@pytest.mark.parametrize("kind", ENCODERS)
def test_what_comes_after_a_lost_byte_is_left_out(tmp_path, kind):
    events = made_up(2000)
    content = b"% geometry 640x480\n" + ENCODERS[kind](events).tobytes()
    half = len(content) // 2
    for lost in (1, 3):
        with pytest.warns(UserWarning) as said:
            _, found = read(
                tmp_path / "a.raw", content[:half] + content[half + lost :], format=kind
            )
        line = f"its words are no {kind.upper()} from byte "
        at = [int(str(one.message).split(line)[1].split()[0]) for one in said if line in str(one)]
        assert len(at) == 1 and half - 8 < at[0] < half + 1000
        assert np.array_equal(found.t[:900], events["t"][:900])
        assert len(found.t) < 1100 or kind == "evt21"  # of which a word holds up to 32


@pytest.mark.parametrize("kind", ["evt2", "evt3"])
def test_words_that_only_a_camera_knows_are_passed_over(tmp_path, kind):
    """One word in 20 of a kind that the format does not name, and 4 KiB of noise."""
    events = made_up(20000)
    words = ENCODERS[kind](events)
    strange = {"evt2": 3 << 28, "evt3": 12 << 12}[kind]
    more = np.insert(words, np.arange(40, len(words), 20), strange)
    header = b"% geometry 640x480\n"
    _, found = read(tmp_path / "a.raw", header + more.tobytes(), format=kind)
    assert np.array_equal(found.t, events["t"])
    noise = np.random.default_rng(0).bytes(4096)
    middle = len(words) // 2 * words.itemsize
    content = words.tobytes()[:middle] + noise + words.tobytes()[middle:]
    _, found = read(tmp_path / "b.raw", header + content, format=kind)
    assert np.array_equal(found.x[-100:], events["x"][-100:])  # times leap, and make a part


def test_a_file_whose_times_come_after_most_events_is_refused(tmp_path):
    events = made_up(400)
    words = evt2(events)
    is_event = words >> 28 < 2
    content = b"% evt 2.0\n" + np.concatenate([words[is_event], words]).tobytes()[:-400]
    with pytest.raises(ValueError, match=r"400 of \d+ events come before the first time"):
        read(tmp_path / "a.raw", content)


@pytest.mark.parametrize(
    ("name", "content", "options", "words"),
    [
        (
            "a.raw",
            b"% plugin gen3\n" + bytes(8),
            {},
            "format must be evt2, evt21 or evt3, got null",
        ),
        ("a.raw", b"% evt 3.0\n" + bytes(8), {"format": "evt2"}, "format must be evt3"),
        ("a.raw", b"% format HISTO3D;width=9\n" + bytes(8), {}, "HISTO3D is not read"),
        ("a.raw", b"% evt 4.0\n" + bytes(8), {}, "EVT4.0 is not read"),
        ("a.raw", b"% evt 3.0\n" + b"\0\xa0" * 5, {}, "no events, only 5 triggers"),
        ("a.raw", b"% evt 2.0\n" + b"\0\0\0\xa0" * 5, {}, "no events, only 5 triggers"),
        ("a.dat", dat(made_up(9), 14), {}, "holds no events, only triggers"),
        ("a.dat", dat(made_up(9), 40), {}, "DAT of type 28 08 is not read"),
        ("a.dat", b"\x0c\x08" + bytes(80), {}, "does not begin with"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, name, content, options, words):
    with pytest.raises(ValueError, match=f"{name}: .*{words}"):
        read(tmp_path / name, content, **options)
