"""Files from elsewhere, damaged in every way: read or refused, within bounds, nothing executed.

They are read in a process with a bound on memory and on computing time, and with an audit hook that
sees what is opened for writing, started or unpickled.  A file may be read, or refused by a
ValueError with a message; anything else fails the test, and so does the death of the process.
"""

import os
import resource
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import faery
import h5py
import numpy as np
import pytest
import torch
from faery.file_encoder import events_to_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from baselines import published
from baselines.firenet import FireNet
from src import simulate
from src.app import simulation
from src.models import files
from src.models.e2vid import E2VID
from src.recordings import sensor_lookup, views
from src.recordings.calibration import view_alignment
from src.recordings.files import recording, recording_inputs, videos
from src.sim.scenes import photo_files, video_files
from tests.baselines.published_names import published_state_dict
from tests.faults.harness import Run
from tests.recordings.files import tables
from tests.recordings.files.test_recording import made_up
from tests.test_train import TINY, config

SPEC = {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 1, "base_channels": 2}}
CORNERS = "- {position: [0, 0], corners: [[10, 10], [90, 12], [88, 95], [9, 90]]}\n"
RAMP = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)


def read_views(path: Path) -> None:
    sensor_lookup.build_lookup(views.load_views(path))


def read_corners(path: Path) -> None:
    corners = view_alignment.read_corners(path)
    view_alignment.views_from_corners(corners, sensor=(240, 320), model=(32, 32))


def read_picture(path: Path) -> None:
    recording_inputs.read_picture_or_event_counts(path)
    photo_files.decode_photograph(path)


def read_video(path: Path) -> None:
    deque(videos.read_video(path), 0)
    for source in video_files.find_videos(path) if path.suffix != ".h5" else ():
        deque(source.read(0, min(source.count, 50)), 0)


def read_published(path: Path) -> None:
    published.load_published("firenet", path)


def read_config(path: Path) -> None:
    cfg = OmegaConf.create({"like": str(path), "large": False})
    try:
        found = simulate.take_clip_config_from_run(
            OmegaConf.merge(cfg, dict.fromkeys(simulate.CLIP_KEYS))
        )
        simulation.build_pipeline(found, "train")
    except OmegaConfBaseException as error:  # an entry point prints it in one line
        raise ValueError(str(error)) from error


def write_events(path: Path, version: str | None = None) -> None:
    tables.write_events(path, made_up(200), width=640, height=480, version=version)


def write_aedat(path: Path, compression: tuple | None = None) -> None:
    listed = np.zeros(200, faery.EVENTS_DTYPE)
    listed["t"] = np.arange(200)
    events_to_file([listed], path, (640, 480), compression=compression, file_type="aedat")


def write_video(path: Path) -> None:
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            frames = np.arange(6 * 16 * 24).reshape(6, 16, 24).astype(np.uint8)
            file.create_dataset("frames", data=frames, chunks=(1, 16, 24), compression="gzip")
        return
    code = cv2.VideoWriter_fourcc(*{".mp4": "mp4v", ".avi": "MJPG"}[path.suffix])
    writer = cv2.VideoWriter(str(path), code, 30, (64, 48), False)
    for number in range(6):
        writer.write(np.full((48, 64), 40 * number, np.uint8))
    writer.release()


def write_network(path: Path) -> None:
    network = E2VID(**SPEC["kwargs"])
    if path.suffix == ".safetensors":
        files.save(path, network, SPEC, {"made": "for a test"})
        return
    state = {f"network.{name}": value for name, value in network.state_dict().items()}
    torch.save({"network": SPEC, "state_dict": state}, path)


def write_published(path: Path) -> None:
    weights = published_state_dict("firenet", FireNet(channels=2))
    torch.save({"state_dict": weights, "epoch": 3, "arch": "FireNet"}, path)


def write_config(path: Path) -> None:
    path.write_text(OmegaConf.to_yaml(config("train", path.parent, *TINY), resolve=True))


PICTURES, TABLES = (".png", ".jpg", ".tif", ".bmp"), (".csv", ".txt", ".npz", ".h5")
FORMATS: dict[str, tuple[str, Callable, Callable]] = {
    "EVT3": (".raw", write_events, recording.read_events),
    "EVT2": (".raw", partial(write_events, version="evt2"), recording.read_events),
    "AEDAT4 unpacked": (".aedat4", write_aedat, recording.read_events),
    **{name: (name, write_events, recording.read_events)
       for name in (".dat", ".aedat4", ".es", *TABLES)},
    **{name: (name, lambda path: cv2.imwrite(str(path), RAMP), read_picture) for name in PICTURES},
    **{f"video{name}": (name, write_video, read_video) for name in (".mp4", ".avi", ".h5")},
    "views.yaml": (".yaml", views.Views.single_view((240, 320), (24, 32)).save, read_views),
    "corners": (".yaml", lambda path: path.write_text(CORNERS), read_corners),
    "config.yaml": (".yaml", write_config, read_config),
    **{name: (name, write_network, files.load) for name in (".safetensors", ".ckpt")},
    "published checkpoint": (".pth", write_published, read_published),
}  # fmt: skip


MEMORY_BYTES = 2 << 30  # beyond what the process holds before it reads
CPU_S = 20  # for one file; more is a hang, and SIGXCPU ends the process
FORBIDDEN = (
    "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect",
)  # fmt: skip
PIECES = [b"\x00", b"\xff", b"\x00" * 4, b"\xff" * 4, b"\x7f\xff\xff\xff", b"-1", b"nan", b"1e999"]
PIECES += [b"9" * 30, b"[" * 40, b"{", b"\n", b"%", b"../", b"&a *a", b"!!", b"."]
KINDS = {  # the bytes from a place on, how many of them are changed, a new piece
    "overwrite": lambda rest, n, piece: piece + rest[len(piece) :],
    "insert": lambda rest, n, piece: piece + rest,
    "remove": lambda rest, n, piece: rest[n:],
    "repeat": lambda rest, n, piece: rest[:n] * (1 + len(piece)) + rest,
    "flip": lambda rest, n, piece: bytes([rest[0] ^ 1 << n % 8]) + rest[1:] if rest else rest,
    "cut": lambda rest, n, piece: b"",
}
PIECE = st.one_of(st.sampled_from(PIECES), st.binary(min_size=1, max_size=12))
CHANGE = st.tuples(st.sampled_from([*KINDS]), st.floats(0, 1), st.integers(1, 64), PIECE)
SEEN: list[str] = []  # of what a reader must not do


def watch(event: str, args: tuple, folder: str) -> None:
    if event == "open" and isinstance(args[0], str) and isinstance(args[2], int):
        is_temporary = os.path.isdir(args[0])  # a file without a name, gone when it is closed
        writes = args[2] & (os.O_WRONLY | os.O_RDWR) and not is_temporary
        if writes and "__pycache__" not in args[0] and not args[0].startswith(folder):
            SEEN.append(f"wrote to {args[0]}")
    elif event.startswith(FORBIDDEN):
        SEEN.append(f"{event} {args[:1]}")


def is_read(read: Callable[[Path], object], path: Path, content: bytes) -> bool:
    """Return whether a file of that content is read; False: it is refused."""
    path.write_bytes(content)
    limit = int(time.process_time()) + CPU_S
    resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
    SEEN.clear()
    try:
        read(path)
    except ValueError as error:
        assert str(error), "a refusal without a message"
        return False
    finally:
        assert not SEEN, f"escaped: {SEEN}"
    return True


def attack(name: str, count: int, folder: str) -> None:
    """Read `count` damaged files of a format in this process."""
    suffix, write, read = FORMATS[name]
    path, results = Path(folder, f"a{suffix}"), []
    write(path)
    whole = path.read_bytes()
    warnings.simplefilter("ignore")
    is_read(read, path, b"x")  # lets the reader import what it imports late
    sys.addaudithook(lambda event, args: watch(event, args, folder))
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY_BYTES, resource.RLIM_INFINITY))
    assert is_read(read, path, whole)

    @settings(
        max_examples=count, deadline=None, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.lists(CHANGE, min_size=1, max_size=6))
    def damage(changes: list[tuple]) -> None:
        data = whole
        for kind, share, length, piece in changes:
            at = int(share * len(data))
            data = data[:at] + KINDS[kind](data[at:], length, piece)
        results.append(is_read(read, path, data or b"\n"))

    damage()
    print(f"{name}: {len(results)} inputs tried, {results.count(False)} refused, 0 crashes")


@pytest.mark.parametrize(
    "count", [100, pytest.param(20_000, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])]
)
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(name, count, tmp_path):
    run = Run(tmp_path / "log", attack, name, count, str(tmp_path))
    ended = run.wait(7200)
    last = [path.read_bytes()[:150] for path in tmp_path.glob("a.*")]
    assert ended == 0, f"the reader ended with {ended} of {last}: {run.text()[-3000:]}"
    print(run.text())
