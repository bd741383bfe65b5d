"""Files from elsewhere, broken in every way: read or refused, within bounds, nothing executed."""

from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.metrics import results
from src.models import files
from src.recordings import formats
from src.recordings.formats import write_events
from src.recordings.views import Views
from tests.faults.inputs import Reader, mutate, mutations
from tests.recordings.test_formats import made_up
from tests.test_train import TINY, config


def read_events(path: Path) -> None:
    from src.recordings import formats

    formats.sensor_size(path)
    formats.read_events(path)


def read_table(path: Path) -> None:
    from src.recordings import formats

    formats.read_events(path)
    _ = formats.open_events(path).size


def read_views(path: Path) -> None:
    from src.recordings import lookup, views

    lookup.build(views.load(path))


def read_corners(path: Path) -> None:
    from src.recordings import alignment

    alignment.by_hand(alignment.read_corners(path), sensor=(240, 320), model=(32, 32))


def read_picture(path: Path) -> None:
    from src.recordings import sources
    from src.sim import scenes

    sources.sensor_picture(path)
    scenes._read(path)


def read_film(path: Path) -> None:
    from src.recordings import sources
    from src.sim import videos

    for _ in sources.film(path):
        pass
    for source in videos.sources(path):
        for _ in source.read(0, min(source.count, 50)):
            pass


def read_network(path: Path) -> None:
    from src.models import files

    files.load(path)


def read_published(path: Path) -> None:
    from baselines import upstream

    upstream.load("firenet", path)


def read_config(path: Path) -> None:
    from src import build, simulate

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


def picture(path: Path) -> None:
    ramp = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)
    assert cv2.imwrite(str(path), ramp)


def film(path: Path) -> None:
    code = {".mp4": "mp4v", ".avi": "MJPG"}[path.suffix]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 30, (64, 48), False)
    for number in range(6):
        writer.write(np.full((48, 64), 40 * number, np.uint8))
    writer.release()


def views(path: Path) -> None:
    Views.single((240, 320), (24, 32)).save(path)


def corners(path: Path) -> None:
    path.write_text("- {position: [0, 0], corners: [[10, 10], [90, 12], [88, 95], [9, 90]]}\n")


def network(path: Path) -> None:
    from src.models import files
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


def test_a_table_leads_to_no_other_file(tmp_path):
    secret = tmp_path / "elsewhere" / "secret.h5"
    secret.parent.mkdir()
    events(secret)
    (tmp_path / "bytes").write_bytes(bytes(64))
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["events"] = h5py.ExternalLink(str(secret), "/events")
    with h5py.File(tmp_path / "external.h5", "w") as file:
        for name in "txyp":
            place = [(str(tmp_path / "bytes"), 0, 64)]
            file.create_dataset(f"events/{name}", (8,), np.int64, external=place)
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout((200,), np.int64)
        layout[:] = h5py.VirtualSource(str(secret), "events/t", (200,))
        file.create_virtual_dataset("events/t", layout)
    for name in ("link.h5", "external.h5", "virtual.h5"):
        with pytest.raises(ValueError, match=f"{name}.*other file"):
            formats.read_events(tmp_path / name, size=(640, 480))


def test_a_small_file_unpacks_to_no_flood(tmp_path):
    zeros = np.zeros(30_000_000, np.int64)
    np.savez_compressed(tmp_path / "bomb.npz", t=zeros, x=zeros[:9], y=zeros[:9], p=zeros[:9])
    with pytest.raises(ValueError, match="unpacks to"):
        formats.read_events(tmp_path / "bomb.npz")


def test_a_file_names_no_network_that_fills_the_memory(tmp_path):
    spec = {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 1, "base_channels": 4096}}
    torch.save({"network": spec, "state_dict": {}}, tmp_path / "huge.ckpt")
    with pytest.raises(ValueError, match="ckpt does not fit"):
        files.load(tmp_path / "huge.ckpt")
    spec["kwargs"]["base_channels"] = 10**9
    torch.save({"network": spec, "state_dict": {}}, tmp_path / "vast.ckpt")
    with pytest.raises(ValueError, match="sizes up to"):
        files.load(tmp_path / "vast.ckpt")


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("name", FORMATS)
def test_very_many_broken_files_are_read_or_refused(name, tmp_path):
    survive(name, tmp_path, 20_000)
