"""Every sweep is a multirun whose jobs compose, and whose last job runs, tiny."""

import json
import os
from pathlib import Path
from weakref import ref

import pytest
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from src.app import build, entry_point
from src.eval import evaluate
from src.models import files
from src.reconstruct import reconstruct
from src.records import results
from src.stress import stress
from src.train import train
from tests.conftest import ROOT
from tests.test_entry_points import run_here
from tests.test_train import TINY, config

SWEEPS = sorted((ROOT / "sweeps").glob("*.yaml"))
CLEAN = ("firenet_plus", "e2vid_plus", "etnet", "hypere2vid")
SMALL = ["scene.height=64", "scene.width=64", "data.test_crop=null", "data.test_clips=1"]
SMALL += ["data.test_windows=5", "data.unscored_windows=1", "data.workers=0", "metrics.lpips=null"]
STRESS = ["ckpt=lf3x3", "clips=1", "processes=1", "data.test_windows=40", "scene.height=64"]
STRESS += ["scene.width=64", "scene.options.dart.speed_px_per_s=4000"]  # long enough in the frame


def content(path: Path) -> dict:
    return OmegaConf.to_container(OmegaConf.load(path), resolve=False)


def jobs(path: Path) -> list[list[str]]:
    params = content(path)["hydra"]["sweeper"]["params"]
    overrides = [f"{key}={value}" for key, value in params.items()]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return BasicSweeper.split_arguments(parsed, max_batch_size=None)[0]


def covering(found: list[list[str]]) -> list[list[str]]:
    """Jobs that together have every override of all."""
    left, chosen = {override for job in found for override in job}, []
    while left:
        chosen.append(max(found, key=lambda job: len(left & set(job))))
        left -= set(chosen[-1])
    return chosen


def composed(path: Path, run: Path, *overrides: str) -> DictConfig:
    """The config of a job of the sweep `path`, as `--config-dir sweeps` makes it."""
    rest = [f"hydra.searchpath=[file://{ROOT / 'conf'}]", f"paths.out={run}"]
    with initialize_config_dir(str(path.parent), version_base=None):
        cfg = compose(path.stem, [*overrides, *rest])
    cfg.paths.run = str(run)
    return cfg


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Files of tiny, untrained networks under the names of weights/."""
    folder, narrow = tmp_path_factory.mktemp("weights"), ("width=4", "~callbacks.progress")
    for name in ("lf3x3", "single256", "setnet_medium", "mambatm", *(f"clean/{n}" for n in CLEAN)):
        path = folder / f"{name}.safetensors"
        path.parent.mkdir(exist_ok=True)
        cfg = config("train", folder, f"experiment={name}", *narrow)
        network, spec = build.build_untrained_network(cfg)
        files.save(path, network, spec, {})
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(files, "WEIGHTS", folder)
        yield


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_every_job_composes_and_the_last_runs(path, tmp_path, weights):
    sweep = content(path)
    entry_point = sweep["defaults"][0]
    assert sweep["defaults"][-1] == "_self_" and sweep["hydra"]["mode"] == "MULTIRUN"
    assert "sweep" not in sweep["hydra"]  # the folder follows from the name: conf/hydra
    found = jobs(path)
    assert len(found) == len({tuple(job) for job in found}) >= 3
    for job in covering(found):
        composed(path, tmp_path, *job)
    tiny, work = {
        "train": ([*TINY, "logger=none", "reference_baseline=null"], train),
        "eval": (SMALL, evaluate),
        "reconstruct": (["ckpt=lf3x3", "end_s=0.005"], reconstruct),
        "stress": (STRESS, stress),
    }[entry_point]
    output = {reconstruct: "video.h5", stress: "stress.csv"}.get(work, "results.json")
    work(composed(path, tmp_path / "last", *found[-1], *tiny))
    assert (tmp_path / "last" / output).is_file()


SCORED = ["-m", "baseline=highpass", "debug=fdr", "metrics.lpips=null"]


def test_a_failed_job_is_named_and_the_rest_stands(tmp_path, capsys):
    assert run_here("eval", *SCORED, "data.test_crop=1000,32", f"paths.out={tmp_path}") == 1
    said = capsys.readouterr().err
    assert "error: 1 failed" in said and "data.test_crop=1000" in said and "Traceback" not in said
    (done,) = tmp_path.rglob("results.json")
    (failed,) = tmp_path.rglob("failed.txt")
    assert "Traceback" in failed.read_text()
    time = done.stat().st_mtime_ns

    assert run_here("eval", *SCORED, "data.test_crop=32", f"paths.out={tmp_path}") == 0
    assert capsys.readouterr().out.count("skipped, its results stand") == 1
    assert done.stat().st_mtime_ns == time


def test_what_a_failed_job_made_is_freed(tmp_path, monkeypatch):
    made, kept = list[ref](), list[bool]()

    def fail(cfg, **_):
        kept.extend(one() is not None for one in made)
        own = DictConfig({})
        made.append(ref(own))
        raise ValueError(f"seed {cfg.seed}")

    monkeypatch.setattr(build, "build_data_module", fail)
    assert run_here("eval", *SCORED, "seed=0,1", f"paths.out={tmp_path}") == 1
    assert kept == [False]


CONFIG = "task: {task}\nckpt: {ckpt}\nlr: {lr}\npaths:\n  run: {run}\nlogger:\n  dir: {run}/logs\n"


def test_a_digest_knows_numbers_but_no_folders():
    plain = {"task": "train", "ckpt": "null", "lr": 1, "run": "/a"}
    digests = [
        results.hash_config(CONFIG.format(**plain | change))
        for change in ({}, {"run": "/b c"}, {"ckpt": "x.ckpt"}, {"lr": 2})
    ]
    assert digests[0] == digests[1] == digests[2] != digests[3]
    earlier = CONFIG.format(**plain) + "verbose: false\n"  # up to 0.6.12
    assert results.hash_config(earlier) == digests[0]
    evaluated = [CONFIG.format(**plain | {"task": "eval", "ckpt": ckpt}) for ckpt in "ab"]
    assert results.hash_config(evaluated[0]) != results.hash_config(evaluated[1])


def test_results_of_another_configuration_are_not_overwritten(tmp_path):
    config = CONFIG.format(task="train", ckpt="null", lr=1, run=tmp_path)
    assert not results.has_results(tmp_path, config)
    record = {"config_sha256": results.hash_config(config)}
    (tmp_path / "results.json").write_text(json.dumps(record))
    assert results.has_results(tmp_path, config)
    with pytest.raises(ValueError, match="paths.out"):
        results.has_results(tmp_path, config.replace("lr: 1", "lr: 2"))
    row = results.ScoreRow("net", [{"ssim": 0.5}], 1, 1, {"8x8": 1.0})
    with pytest.raises(ValueError, match="paths.out"):  # that came while it ran
        results.write_and_print_results(tmp_path, config.replace("lr: 1", "lr: 2"), [row])
    assert json.loads((tmp_path / "results.json").read_text()) == record


def test_results_older_than_the_weights_are_made_again(tmp_path):
    stored, weights = tmp_path / "results.json", tmp_path / "w.safetensors"
    stored.write_text("{}")
    weights.write_text("")
    cfg = OmegaConf.create({"task": "eval", "ckpt": str(weights)})
    os.utime(weights, (0, 0))
    assert not entry_point._has_newer_weights(cfg, stored)
    os.utime(weights, (2**32, 2**32))
    assert entry_point._has_newer_weights(cfg, stored)
    cfg.task = "train"  # of which it is where it began
    assert not entry_point._has_newer_weights(cfg, stored)


def test_jitter_at_768_is_measured_alike_by_both_tables(tmp_path):
    table1 = composed(ROOT / "sweeps" / "table1.yaml", tmp_path, "experiment=single768")
    s1 = composed(ROOT / "sweeps" / "table_s1.yaml", tmp_path, "resolution=native768")
    assert table1.scene.width == s1.scene.width == 768
    assert table1.metrics.jitter_reduction == s1.metrics.jitter_reduction == 3


TRAINED = ["-m", "debug=fdr", "metrics.lpips=null", "loss=l1", "logger=none", "seed=0,1"]
TRAINED += ["reference_baseline=null", "trainer.precision=null"]


def test_a_sweep_of_trainings_that_starts_again_skips_what_is_done(tmp_path, capsys):
    sweep = [*TRAINED, "start=single256", "experiment=single256", f"paths.out={tmp_path}"]
    for skipped in (0, 2):
        assert run_here("train", *sweep) == 0, capsys.readouterr().err
        assert capsys.readouterr().out.count("skipped, its results stand") == skipped


def test_results_of_other_code_are_named_where_they_stand(tmp_path):
    stored = tmp_path / "results.json"
    stored.write_text(json.dumps({"git": "v0"}))
    now = results.git_commit()
    assert entry_point._describe_other_code(stored) == f"; of code at v0, which is now at {now}"
    stored.write_text(json.dumps({"git": now}))
    assert entry_point._describe_other_code(stored) == ""


def test_results_of_a_training_from_other_weights_do_not_stand(tmp_path):
    stored = tmp_path / "results.json"
    for before, now, same in (
        (None, "run/checkpoints", True), ("a.safetensors", "a.safetensors", True),
        (None, "a.safetensors", False), ("a.safetensors", None, False),
    ):  # fmt: skip
        stored.write_text(json.dumps({"resumed_from": before}))
        cfg = OmegaConf.create({"ckpt": now})
        if same:
            entry_point._check_same_beginning(cfg, stored)
        else:
            with pytest.raises(ValueError, match="ckpt must be"):
                entry_point._check_same_beginning(cfg, stored)
