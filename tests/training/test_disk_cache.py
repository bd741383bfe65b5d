"""The cache on a disk: the simulation to float16, whoever makes it and whatever is there."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest
import torch

from scripts.fill_cache import fill_clip_cache
from src.app import simulation as simulations
from src.models.checkpoints import is_intact
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline
from src.sim.sensor.sensor import EventSensor
from src.sim.turbulence.simulated import SimulatedTurbulence
from src.simulate import simulate
from src.train import train
from src.training import disk_cache as disk_caches
from src.training.augment import Augment
from src.training.clip_cache import FIRST_CLIPS, SAMPLES_PER_CLIP, CachedPipeline
from src.training.datamodule import LightFieldData
from src.training.disk_cache import (
    CacheFillerProcess,
    DiskClipCache,
    hash_file_lists,
    hash_simulation_code,
)
from tests.faults.harness import FORKS
from tests.faults.test_surroundings import small_files
from tests.sim.test_pipeline import Waves
from tests.test_train import TINY, config
from tests.training.cache_sources import Slow, start_filler
from tests.training.test_datamodule import FakeTrainer

WEAK = SimulatedTurbulence({"severity": "weak"})
DRAWN = {
    "threshold": 0.2,
    "initial_reference_error": 1.0,
    "random": {"threshold": [0.1, 0.3], "dark_noise_hz": [0, 5]},
}


def source(optics=None, turbulence=WEAK, scene=None, **kwargs) -> Pipeline:
    return Pipeline(
        scene or Waves(frames=7, side=40), optics or Optics(9), turbulence, EventSensor(),
        split="train", crop=24, random_crop=True, **kwargs,
    )  # fmt: skip


def disk_cache(
    root: Path, clips: int = 3, *, inputs=None, gib: float = 1.0, **kwargs
) -> DiskClipCache:
    return DiskClipCache(
        source(**kwargs), root, inputs or {"seed": 0}, clips=clips, frames=7, gib=gib
    )


def cached(of: DiskClipCache, views: int = 9, sensor=DRAWN, **kwargs) -> CachedPipeline:
    return CachedPipeline(
        of, Optics(views), EventSensor(**sensor), **{"windows": 4, "crop": 16} | kwargs
    )


def test_a_sample_is_the_simulation_to_the_rounding_of_float16(tmp_path):
    chain = cached(disk_cache(tmp_path), sensor={"threshold": 0.2})
    for number in range(8):
        draw = chain.draw(number)
        air = chain.cache.source.draw(draw.index)
        whole = chain.cache.source.render_views([air])[0, list(draw.view_order)]
        top, left, height, width = draw.crop
        rows, columns = slice(top, top + height), slice(left, left + width)
        part = whole[:, list(draw.frames), rows, columns]
        torch.testing.assert_close(
            chain.render_views([draw])[0].float(), part, rtol=2**-11, atol=1e-7
        )
        clean = air.clip.frames[list(draw.frames), air.crop[0] :, air.crop[1] :][:, rows, columns]
        target = chain.simulate_sensor([draw], chain.render_views([draw])).target[0, :, 0]
        torch.testing.assert_close(target, clean[1:], rtol=2**-11, atol=1e-7)


def test_a_sample_is_a_function_of_its_number_and_not_of_what_the_cache_holds(tmp_path):
    full, empty = disk_cache(tmp_path / "full"), disk_cache(tmp_path / "empty")
    full.fill()
    for number in (5, 0, 200):
        ours, theirs = (
            chain.simulate([chain.draw(number)]) for chain in map(cached, (full, empty))
        )
        assert torch.equal(ours.voxels, theirs.voxels) and torch.equal(ours.target, theirs.target)
        assert ours.parameters == theirs.parameters
    assert not full.missing()


def test_numbers_differ_in_all_that_is_drawn(tmp_path):
    chain = cached(disk_cache(tmp_path))
    draws = [chain.draw(number) for number in range(24)]
    assert {draw.index for draw in draws} == {0, 1, 2}
    assert {min(draw.frames) for draw in draws} == {0, 1, 2} and len({d.crop for d in draws}) > 10
    assert {draw.frames.step for draw in draws} == {-1, 1}
    assert len({draw.view_order for draw in draws}) == 24
    assert len({draw.sensor.threshold for draw in draws}) == 24
    assert len({draw.sensor.seed for draw in draws}) == 24


def test_of_few_samples_the_first_come_again(tmp_path):
    of = disk_cache(tmp_path)
    few, many = cached(of, clips=2), cached(of)
    again = few.simulate([few.draw(3)]).voxels
    first, third = (many.simulate([many.draw(number)]).voxels for number in (1, 3))
    assert torch.equal(again, first) and not torch.equal(again, third)
    assert few.repeats_samples and not many.repeats_samples


def test_early_numbers_take_the_clips_that_are_filled_first(tmp_path):
    chain = cached(disk_cache(tmp_path, clips=100), sensor={})
    assert all(
        chain.clip_index(number) < FIRST_CLIPS + number // SAMPLES_PER_CLIP for number in range(40)
    )
    assert max(chain.clip_index(number) for number in range(1000, 1400)) > 95


def test_few_samples_are_of_all_clips_of_a_disk_cache(tmp_path):
    of = disk_cache(tmp_path, clips=100)
    few, many = (cached(of, sensor={}, clips=clips) for clips in (100, 400))
    assert (
        max(few.clip_index(number) for number in range(100)) > FIRST_CLIPS + 100 // SAMPLES_PER_CLIP
    )
    assert all(few.clip_index(number) < FIRST_CLIPS + number for number in range(100))
    assert all(many.clip_index(n) == cached(of, sensor={}).clip_index(n) for n in range(0, 400, 7))


def test_law_2_a_single_view_is_the_centre_view_of_the_same_disk_cache(tmp_path):
    of = disk_cache(tmp_path)
    nine, one = cached(of), cached(of, views=1)
    for number in range(4):
        ours, theirs = (chain.simulate([chain.draw(number)]) for chain in (nine, one))
        assert torch.equal(ours.voxels[:, :, 4:5], theirs.voxels)
        assert torch.equal(ours.turbulent, theirs.turbulent)


def test_law_3_a_batch_changes_nothing(tmp_path):
    chain = cached(disk_cache(tmp_path))
    together, alone = (chain.simulate([chain.draw(n) for n in some]) for some in ([4, 9], [9]))
    assert torch.equal(together.voxels[1:], alone.voxels)


def test_views_that_share_their_air_keep_their_places(tmp_path):
    shared = cached(disk_cache(tmp_path), shuffle_views=False)
    assert shared.draw(0).view_order == tuple(range(9))


def test_the_fewest_clips_there_can_be_and_more_later(tmp_path):
    disk_cache(tmp_path, clips=1).fill()
    more = disk_cache(tmp_path, clips=3)
    assert more.missing() == [1, 2]
    assert "1 of 3 clips" in more.status()


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_a_flipped_bit_is_found_and_the_clip_made_again(tmp_path):
    disk_cache(tmp_path).fill()
    again, path = disk_cache(tmp_path), disk_cache(tmp_path).path(1)
    before = path.read_bytes()
    flipped(path)
    with pytest.warns(UserWarning, match="000001.pt is damaged and simulated again"):
        again.clip(1)
    assert path.read_bytes() == before
    again.clip(1)


@pytest.mark.parametrize("left", [0, 100, 20_000])
def test_half_a_file_is_made_again(left, tmp_path):
    disk_cache(tmp_path, clips=1).fill()
    path = disk_cache(tmp_path, clips=1).path(0)
    before = path.read_bytes()
    path.write_bytes(before[:left])
    with pytest.warns(UserWarning, match="is damaged"):
        disk_cache(tmp_path, clips=1).clip(0)
    assert path.read_bytes() == before


def test_a_cache_of_another_config_is_named_and_not_used(tmp_path):
    disk_cache(tmp_path, inputs={"seed": 0, "scene": {"speed": 1}}).fill()
    other = disk_cache(tmp_path, inputs={"seed": 1, "scene": {"speed": 1}})
    assert len(other.missing()) == 3
    assert other.status().endswith("; 1 of other configs, see their inputs.json")


SMALL = ["scene.height=64", "scene.width=64", "data.cache_windows=4", "data.cache_crop=24"]
SMALL += ["data.windows=3", "data.crop=16", "turbulence=weak", "sensor=randomized"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("data.cache_clips=0", "data.cache_clips must be a whole number >= 1, got 0"),
        ("data.cache_clips=2.5", "data.cache_clips must be a whole number >= 1, got 2.5"),
        ("data.cache_clips=many", "data.cache_clips must be a whole number >= 1, got many"),
        ("data.cache_gib=big", "data.cache_gib must be a number, got big"),
        ("data.cache_gib=nan", "data.cache_gib must be >= 0.00 for data.cache_clips=2, .* got nan"),
        ("data.cache_crop=0", "data.cache_crop must be a whole number >= 1"),
        ("data.cache_windows=2", "data.windows must be <= data.cache_windows, 2, got 3"),
        (
            "sensor.random.threshold=[0.1,9]",
            r"sensor.random.threshold must be in \[0.01, 5\], got 9",
        ),
    ],
)
def test_wrong_values_of_a_config_are_one_line(wrong, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        asked = ["data.cache_clips=2", f"data.cache_root={tmp_path}", wrong]
        simulations.build_pipeline(config("train", tmp_path, *SMALL, *asked), "train")


def clip_cache_folder(root: Path, *changed: str) -> Path:
    asked = ["data.cache_clips=2", f"data.cache_root={root}"]
    return simulations.build_clip_cache(config("train", root, *SMALL, *asked, *changed)).folder


@pytest.fixture(scope="module")
def root_and_folder(tmp_path_factory) -> tuple[Path, Path]:
    """The root of caches and the folder of one that others are compared with."""
    root = tmp_path_factory.mktemp("caches")
    return root, clip_cache_folder(root)


@pytest.mark.parametrize(
    ("changed", "same"),
    [
        (["optics=single"], True),
        (["optics=lf1x3", "data.cache_clips=5", "data.windows=2", "data.crop=20"], True),
        (["sensor=paper", "augment=none", "data.cache_gib=3"], True),
        (["optics=lf5x5"], False),
        (["optics=single", "turbulence=none"], False),
        (["sensor.input=srgb"], False),
        (["seed=1"], False),
        (["turbulence=medium"], False),
        (["data.rates=[120,240]"], False),
        (["scene.speed_widths_per_s=[0.1,0.2]"], False),
        (["data.cache_windows=5"], False),
    ],
)
def test_a_cache_is_shared_by_all_that_its_clips_do_not_depend_on(changed, same, root_and_folder):
    root, folder = root_and_folder
    assert (clip_cache_folder(root, *changed) == folder) == same


def test_without_turbulence_a_cache_holds_the_views_asked_for(tmp_path):
    asked = [
        *SMALL,
        "turbulence=none",
        "optics=single",
        "data.cache_clips=1",
        f"data.cache_root={tmp_path}",
    ]
    chain = simulations.build_pipeline(config("train", tmp_path, *asked), "train")
    assert chain.cache.clip(0).views.shape[0] == 1
    assert chain.simulate([chain.draw(0)]).voxels.shape[2] == 1


def test_batches_are_the_same_whatever_the_workers_and_the_step_begun_at(tmp_path):
    def batches(root: str, workers: int, step: int) -> list[torch.Tensor]:
        data = LightFieldData(
            {"train": cached(disk_cache(tmp_path / root))}, Augment(), batch_size=2, epoch_clips=8,
            workers=workers,
        )  # fmt: skip
        data.trainer = FakeTrainer(step)
        return [batch.voxels for batch in data.train_dataloader()]

    whole = batches("a", 0, 0)
    for others in (batches("b", 2, 0), batches("c", 0, 2)):
        assert len(others) in (2, 4)
        assert all(map(torch.equal, whole[-len(others) :], others))


def test_a_training_takes_steps_from_a_cache_and_fills_it(tmp_path):
    asked = [
        *TINY,
        *SMALL,
        "data.cache_clips=3",
        f"data.cache_root={tmp_path / 'cache'}",
        "optics=lf2",
    ]
    train(config("train", tmp_path / "run", *asked, "trainer.max_steps=2", "data.epoch_clips=2"))
    (folder,) = (tmp_path / "cache").iterdir()
    assert list(folder.glob("*.pt")) and (tmp_path / "run" / "results.json").is_file()
    like = ["split=train", "index=5", f"like={tmp_path / 'run' / 'config.yaml'}"]
    seen = simulate(config("simulate", tmp_path / "seen", *like))
    assert (
        seen["clip"] == 5
        and seen["cached_clip"] < 3
        and (tmp_path / "seen" / "views.png").is_file()
    )


def test_more_than_the_bound_or_the_disk_is_refused(tmp_path, monkeypatch):
    with pytest.raises(
        ValueError, match=r"data.cache_gib must be >= 0.08 for data.cache_clips=1000"
    ):
        disk_cache(tmp_path, clips=1000, gib=0.01)
    free = type("Usage", (), {"free": 1000})
    monkeypatch.setattr("shutil.disk_usage", lambda folder: free)
    with pytest.raises(ValueError, match="data.cache_root must have 0.00 GiB free"):
        disk_cache(tmp_path)


def test_more_windows_than_the_cache_has_are_refused(tmp_path):
    with pytest.raises(ValueError, match="data.windows must be <= data.cache_windows, 6, got 7"):
        cached(disk_cache(tmp_path), windows=7)


def test_a_full_disk_while_filling(tmp_path):
    of = disk_cache(tmp_path)
    other = cached(disk_cache(tmp_path / "other"))
    whole = other.simulate([other.draw(1)])
    with small_files(50_000):
        with pytest.raises(OSError, match="cannot be stored"):
            of.fill()
        with pytest.warns(UserWarning, match="cannot be stored"):
            sample = cached(of).simulate([cached(of).draw(1)])
    assert torch.equal(sample.voxels, whole.voxels)
    assert len(of.missing()) == 3 and not list(of.folder.glob("*.partial"))


def work(of: DiskClipCache) -> None:
    torch.set_num_threads(1)
    of.fill()


def test_killed_again_and_again_the_cache_is_the_same(tmp_path):
    (alone := disk_cache(tmp_path / "alone", scene=Slow())).fill()
    of = disk_cache(tmp_path / "killed", scene=Slow())
    forks = multiprocessing.get_context("fork")
    for pause in (0.05, 0.25, 0.3, 0.1):
        process = forks.Process(target=work, args=(of,))
        process.start()
        time.sleep(pause)
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    of.fill()  # nobody's lock is left
    for index in range(3):
        assert of.path(index).read_bytes() == alone.path(index).read_bytes()


def test_who_needs_a_clip_that_another_makes_waits_for_it(tmp_path, monkeypatch):
    of = disk_cache(tmp_path, scene=Slow(), clips=1)
    process = multiprocessing.get_context("fork").Process(target=work, args=(of,))
    process.start()
    while not (of.folder / "clips.lock").exists():
        time.sleep(0.01)
    time.sleep(0.1)
    monkeypatch.setattr(disk_caches, "simulate_clip", lambda *_: pytest.fail("made twice"))
    of.clip(0)
    process.join()


def test_several_processes_fill_a_cache_beforehand(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: FORKS)  # the imports are done
    of = disk_cache(tmp_path, clips=4)
    fill_clip_cache(of, 2)
    assert not of.missing() and all(is_intact(of.path(index)) for index in range(4))
    assert "0 of 4 clips" in (printed := capsys.readouterr().out) and "4 of 4 clips" in printed


def test_a_filler_ends_with_the_training_that_started_it(tmp_path):
    of = disk_cache(tmp_path, clips=500, scene=Slow())
    spawn = multiprocessing.get_context("spawn")
    training = spawn.Process(target=start_filler, args=(of, tmp_path / "pid"))
    training.start()
    until(lambda: list(of.folder.glob("*.pt")))
    filler = int((tmp_path / "pid").read_text())
    os.kill(training.pid, signal.SIGKILL)
    training.join()
    until(lambda: not runs(filler))


def test_of_two_fillers_one_fills_and_the_other_takes_over_and_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: FORKS)  # the imports are done
    first, second = (CacheFillerProcess(disk_cache(tmp_path, 6, scene=Slow())) for _ in range(2))
    first.start()
    until(lambda: list(tmp_path.glob("*/*.pt")))
    second.start()
    first.stop()
    second.process.join(600)
    assert second.process.exitcode == 0 and not second.caches[0].missing()
    second.stop()
    second.start()
    assert second.process is None


def until(seen) -> None:
    end = time.monotonic() + 600  # the lowest priority on a busy machine
    while not seen():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


def runs(pid: int) -> bool:
    """Return whether a process is there and no zombie."""
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


def test_files_of_a_scene_are_part_of_what_made_a_disk_cache(tmp_path):
    (tmp_path / "a.png").write_bytes(b"1")
    node = {"parts": [{"root": [str(tmp_path)]}, {"root": None}]}
    footage = {"turbulence": {"footage": str(tmp_path)}}
    before = hash_file_lists(node)
    assert before == hash_file_lists(footage) == hash_file_lists({"root": str(tmp_path)})
    (tmp_path / "b.png").write_bytes(b"1")
    assert hash_file_lists(node) != before and hash_file_lists(footage) != before
    assert hash_simulation_code() == hash_simulation_code() != ""


def test_files_in_linked_folders_are_in_the_hash_hidden_ones_are_not(tmp_path):
    root, other = tmp_path / "root", tmp_path / "other"
    for folder in (root, other):
        folder.mkdir()
    (root / "link").symlink_to(other)
    (root / "loop").symlink_to(root)
    hashes = []
    for place in (root / "a.png", root / ".hidden.png", other / "b.png"):
        place.write_bytes(b"0")
        hashes.append(hash_file_lists({"root": str(root)}))
    assert hashes[0] == hashes[1] != hashes[2]


def test_the_hash_is_of_what_makes_clips():
    files = {path.name for path in disk_caches.list_simulation_files()}
    assert {"turbulence_file.py", "response.py", "p2s.py", "p2s.safetensors"} <= files
    assert not {"sensor.py", "voxel.py", "user_clip.py"} & files


def test_comments_docstrings_and_layout_of_code_are_not_hashed(tmp_path):
    texts = (
        '"""A."""\nclass A:\n    """B."""\n    def f(self):\n        """C."""\n        return 1\n',
        "class A:\n    # other\n    def f(self):\n        return (\n            1)\n",
        "class A:\n    def f(self):\n        return 2\n",
    )
    contents = []
    for text in texts:
        (tmp_path / "a.py").write_text(text)
        contents.append(disk_caches.read_without_comments(tmp_path / "a.py"))
    assert contents[0] == contents[1] != contents[2]


def test_code_is_hashed_once_a_process(monkeypatch):
    before = hash_simulation_code()
    monkeypatch.setattr(disk_caches, "read_without_comments", None)
    assert hash_simulation_code() == before
