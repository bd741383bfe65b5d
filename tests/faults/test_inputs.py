"""Files from elsewhere, broken in every way: read or refused, within bounds, nothing executed."""

from collections.abc import Callable
from pathlib import Path

import cv2
import faery
import h5py
import numpy as np
import pytest
import torch
from faery.file_encoder import events_to_file
from hypothesis import HealthCheck, given, settings
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.models import files
from src.recordings.files import formats, sources
from src.recordings.files.formats import write_events
from src.recordings.views import Views
from src.records import results
from tests.faults.inputs import Reader, mutate, mutations
from tests.recordings.files.test_formats import made_up
from tests.test_train import TINY, config


def read_events(path: Path) -> None:

    sources.sensor_size(path)
    formats.read_events(path)


def read_table(path: Path) -> None:

    formats.read_events(path)
    _ = formats.open_events(path).size


def read_views(path: Path) -> None:
    from src.recordings import lookup, views

    lookup.build(views.load(path))


def read_corners(path: Path) -> None:
    from src.recordings.calibration import alignment

    alignment.by_hand(alignment.read_corners(path), sensor=(240, 320), model=(32, 32))


def read_picture(path: Path) -> None:
    from src.recordings.files import sources
    from src.sim.scenes import photo_files

    sources.sensor_picture(path)
    photo_files.read(path)


def read_film(path: Path) -> None:
    from src.recordings.files import sources
    from src.sim.scenes import videos

    for _ in sources.film(path):
        pass
    for source in videos.sources(path):
        for _ in source.read(0, min(source.count, 50)):
            pass


def read_whole_film(path: Path) -> None:
    from src.recordings.files import sources

    for _ in sources.film(path):
        pass


def read_network(path: Path) -> None:

    files.load(path)


def read_published(path: Path) -> None:
    from baselines import upstream

    upstream.load("firenet", path)


def read_config(path: Path) -> None:
    from src import simulate
    from src.app import build

    cfg = OmegaConf.create({"like": str(path)})
    try:
        found = simulate.alike(OmegaConf.merge(cfg, dict.fromkeys(simulate.SAME)))
        build.pipeline(found, "train")
    except OmegaConfBaseException as error:  # the doors print it in one line, as a ValueError
        raise ValueError(str(error)) from error


def events(path: Path, **how) -> None:
    write_events(path, made_up(200), width=640, height=480, **how)


def evt2(path: Path) -> None:
    events(path, version="evt2")


def unpacked(path: Path, compression: tuple | None = None) -> None:
    listed = np.zeros(200, faery.EVENTS_DTYPE)
    listed["t"] = np.arange(200)
    events_to_file([listed], path, (640, 480), compression=compression, file_type="aedat")


def picture(path: Path) -> None:
    ramp = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)
    assert cv2.imwrite(str(path), ramp)


def film(path: Path) -> None:
    code = {".mp4": "mp4v", ".avi": "MJPG"}[path.suffix]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 30, (64, 48), False)
    for number in range(6):
        writer.write(np.full((48, 64), 40 * number, np.uint8))
    writer.release()


def film_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        frames = np.arange(6 * 16 * 24).reshape(6, 16, 24).astype(np.uint8)
        file.create_dataset("frames", data=frames, chunks=(1, 16, 24), compression="gzip")


def views(path: Path) -> None:
    Views.single((240, 320), (24, 32)).save(path)


def corners(path: Path) -> None:
    path.write_text("- {position: [0, 0], corners: [[10, 10], [90, 12], [88, 95], [9, 90]]}\n")


def network(path: Path) -> None:
    from src.models.e2vid import E2VID

    spec = {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 1, "base_channels": 2}}
    made = E2VID(**spec["kwargs"])
    if path.suffix == ".safetensors":
        files.save(path, made, spec, {"made": "for a test"})
        return
    state = {f"network.{name}": value for name, value in made.state_dict().items()}
    torch.save({"network": spec, "state_dict": state}, path)


def published(path: Path) -> None:
    from baselines import upstream
    from baselines.firenet import FireNet

    weights = upstream.export("firenet", FireNet(channels=2))
    torch.save({"state_dict": weights, "epoch": 3, "arch": "FireNet"}, path)


def run_config(path: Path) -> None:
    results.write_text(path, OmegaConf.to_yaml(config("train", path.parent, *TINY), resolve=True))


FORMATS: dict[str, tuple[str, Callable, Callable]] = {
    "EVT3": (".raw", events, read_events),
    "EVT2": (".raw", evt2, read_events),
    "DAT": (".dat", events, read_events),
    "AEDAT4": (".aedat4", events, read_events),
    "AEDAT4 unpacked": (".aedat4", unpacked, read_events),
    "ES": (".es", events, read_events),
    "CSV": (".csv", events, read_table),
    "text": (".txt", events, read_table),
    "npz": (".npz", events, read_table),
    "HDF5": (".h5", events, read_table),
    "PNG": (".png", picture, read_picture),
    "JPEG": (".jpg", picture, read_picture),
    "TIFF": (".tif", picture, read_picture),
    "BMP": (".bmp", picture, read_picture),
    "MP4": (".mp4", film, read_film),
    "AVI": (".avi", film, read_film),
    "HDF5 film": (".h5", film_h5, read_whole_film),
    "views.yaml": (".yaml", views, read_views),
    "corners": (".yaml", corners, read_corners),
    "config.yaml": (".yaml", run_config, read_config),
    "safetensors": (".safetensors", network, read_network),
    "checkpoint": (".ckpt", network, read_network),
    "published checkpoint": (".pth", published, read_published),
}


def survive(name: str, folder: Path, count: int) -> None:
    """Read `count` broken files of a format; one file that is whole comes first."""
    suffix, make, read = FORMATS[name]
    make(folder / f"whole{suffix}")
    whole = (folder / f"whole{suffix}").read_bytes()
    with Reader(suffix, read) as reader:
        assert reader(whole) == "read"

        @settings(
            max_examples=count,
            deadline=None,
            database=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        )
        @given(changes=mutations())
        def attack(changes: list[tuple]) -> None:
            reader(mutate(whole, changes))

        attack()
        reader.tell(name)


@pytest.mark.parametrize("name", FORMATS)
def test_broken_files_are_read_or_refused(name, tmp_path):
    survive(name, tmp_path, 100)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("name", FORMATS)
def test_very_many_broken_files_are_read_or_refused(name, tmp_path):
    survive(name, tmp_path, 20_000)
