"""A time-limited training: from its folder to going on with what it left, cut anywhere."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from scripts.lease import __main__ as lease
from scripts.lease import export
from src.models import files
from src.train import train
from tests.conftest import ROOT
from tests.test_lease_plan import DRY, begun, pack, plan
from tests.test_train import config

NOT_NEEDED = ("wandb", "kornia", "faery", "aiohttp", "h5py", "av", "rosbags", "hdf5plugin")
# Imports once; each lease, {name: [its words, whether training hangs]}, is a child of its own.
DRIVER = """
import json, os, sys, time
import scripts.lease.run
from scripts.lease import __main__ as lease
def hang(*_, **__): time.sleep(600)
for name, (words, hangs) in json.loads(sys.argv[1]).items():
    pid = os.fork()
    if pid == 0:
        log = os.open(f"{name}.log", os.O_WRONLY | os.O_CREAT)
        os.dup2(log, 1)
        os.dup2(log, 2)
        if hangs:
            scripts.lease.run.Lease._fill_and_train = hang
        lease.START, sys.argv, code = time.monotonic(), ["lease", *words], 0
        try:
            lease.main()
        except SystemExit as end:
            code = end.code
        loaded = sorted({module.split(".")[0] for module in sys.modules})
        print("seconds", time.monotonic() - lease.START, "modules", *loaded, flush=True)
        os._exit(code)
    print(name, pid, flush=True)
for _ in range(len(json.loads(sys.argv[1]))):
    print(*os.wait(), flush=True)
"""


class Cut(BaseException):
    pass


@pytest.mark.parametrize("two_fit", [True, False])
def test_cut_anywhere_an_export_is_whole_or_named_as_lost(two_fit, tmp_path, monkeypatch):
    """Of a network whose weights are all 1, then all 2, cut before each change of the folder."""
    net = files.load(begun(tmp_path / "begun.safetensors", 1))
    spec = {"target": "src.models.e2vid.E2VID", "kwargs": {"base_channels": 4, "bins": 5}}
    left, real = [0], {"replace": os.replace, "unlink": Path.unlink}

    def counted(name):
        def do(*arguments, **options):
            if not left[0]:
                raise Cut
            left[0] -= 1
            return real[name](*arguments, **options)

        return do

    for value in (1, 2):
        for weight in net.parameters():
            weight.data.fill_(value)
        files.save(tmp_path / f"{value}.safetensors", net, spec, {"steps": value})
    seen = []
    while len(seen) < 9:
        out = tmp_path / f"out{len(seen)}"
        exports = export.Exports(out, 2**18, 2**21 if two_fit else 2**19 + 2**18, 8)
        exports.export_weights("a", tmp_path / "1.safetensors", {})
        left[0] = len(seen)
        with monkeypatch.context() as patched:
            patched.setattr(os, "replace", counted("replace"))
            patched.setattr(Path, "unlink", counted("unlink"))
            try:
                exports.export_weights("a", tmp_path / "2.safetensors", {})
                break
            except Cut:
                pass
        made, lost = export.join_exports(out, tmp_path / "joined")
        weights = [w.unique() for path in made for w in files.load(path).state_dict().values()]
        cards = [files.read_card(path) for path in made]
        values = {float(value) for value in weights} | {card["steps"] for card in cards}
        seen += [values.pop()] if len(values) == 1 else lost
    if two_fit:
        assert seen == [1, 1, 2, 2]
        return
    begin = "a: weights of no generation are whole: generation "
    ends = ["1 has parts 2 of 2", "1 has parts 2 of 2; generation 2 has parts 1 of 2"]
    assert seen == [1, *(begin + end for end in [*ends, "2 has parts 1 of 2"])]


@pytest.fixture(scope="module")
def leases(tmp_path_factory):
    """Three leases side by side: a whole one, one that is killed and one whose training hangs."""
    home = tmp_path_factory.mktemp("leases")
    here = plan(home / "plan", max_export_total_mib=8, max_export_file_mib=1.5, networks=[
        {"name": "lf3x3", "minutes": 0.04},
        {"name": "single256", "minutes": 0.04, "start": "../begun.safetensors"},
    ])  # fmt: skip
    begun(home / "begun.safetensors", 0.5)
    scenes = {"scenes": pack(home / "photos.pack")}
    assert lease.run_command(["folder", home / "all", here], scenes, 0) == 0
    short = {"check_s": 1, "margin_s": 4, "validate": {"total_s": 1}}
    row = {"name": "single256", "minutes": 0.02, "overrides": ["data.cache_clips=null"]}
    short["networks"] = [row]
    first = OmegaConf.to_container(OmegaConf.load(DRY))["networks"][:1]
    cut = plan(home / "cut", export_interval_s=0.05, check_s=1, networks=first)
    words = {
        "whole": [[str(home / "all" / "plan.yaml"), "--minutes", "9"], False],
        "killed": [[str(cut), "--minutes", "9"], False],
        "hangs": [[str(plan(home / "hang", **short)), "--minutes", "0.2"], True],
    }
    for name, (line, _) in words.items():
        line.append(f"out={home / f'{name}.out'}")
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, json.dumps(words)], cwd=home, text=True,
        stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    pids = dict(driver.stdout.readline().split() for _ in words)
    end = time.monotonic() + 240
    while not any((home / "killed.out").glob("lf3x3.g[2-9]*.part2*")):
        assert time.monotonic() < end, (home / "killed.log").read_text()
        time.sleep(0.01)
    time.sleep(random.uniform(0, 0.3))
    os.kill(int(pids["killed"]), signal.SIGKILL)
    ended = dict(line.split() for line in driver.communicate(timeout=240)[0].splitlines())
    codes = {name: os.waitstatus_to_exitcode(int(ended[pid])) for name, pid in pids.items()}
    logs = {name: (home / f"{name}.log").read_text() for name in words}
    return SimpleNamespace(home=home, codes=codes, logs=logs)


def test_a_whole_lease_trains_exports_and_says_what(leases):
    log, out = leases.logs["whole"], leases.home / "whole.out"
    assert leases.codes["whole"] == 0, log
    gathered = {path.name for path in (leases.home / "all").iterdir()}
    assert gathered == {"plan.yaml", "photos.pack", "start-single256.safetensors"}
    for line in ("torch", "steps/s", " clips in ", "trained: lf3x3, single256; in"):
        assert line in log
    names = sorted(path.name for path in out.iterdir())
    assert len(names) <= 8 and {"curves.csv", "profile.json"} < set(names)
    assert all(path.stat().st_size <= 1.5 * 2**20 for path in out.iterdir())
    profile = json.loads((out / "profile.json").read_text())
    pair = profile["networks"]
    assert pair["lf3x3"]["steps"] > 0 and pair["single256"]["hours"] > 0.5
    assert pair["single256"]["steps"] == 5 + pair["single256"]["trained"]
    rows = (out / "curves.csv").read_text().splitlines()
    assert rows[0].startswith("network,hours,steps,windows,loss") and len(rows) >= 5
    modules = set(log.rsplit("modules", 1)[1].split())
    assert not modules & set(NOT_NEEDED) and not (leases.home / ".whole.out.partial").exists()


def test_what_a_lease_exports_is_gone_on_with(leases, tmp_path, capsys):
    out, weights = leases.home / "whole.out", tmp_path / "lf3x3.safetensors"
    assert lease.run_command(["join", out], {"to": tmp_path}, 0) == 0
    said = capsys.readouterr().out.splitlines()
    names = ("lf3x3.safetensors", "single256.safetensors")
    assert [line.split(":")[0] for line in said] == [str(tmp_path / name) for name in names]
    wanted = "continue: python -m src.train experiment=lf3x3 budget=lease trainer=cpu"
    assert wanted in said[0]
    card = files.read_card(weights)
    before = json.loads((out / "profile.json").read_text())["networks"]["lf3x3"]
    assert card["steps"] == before["steps"] and card["curve"][-1]["steps"] == before["steps"]
    small = ["data.test_clips=1", "~callbacks.progress", "trainer.max_steps=1", "train_hours=9"]
    words = ["experiment=lf3x3", *card["overrides"], *small]
    train(config("train", tmp_path / "on", *words, f"ckpt={weights}"))
    stored = torch.load(tmp_path / "on" / "checkpoints" / "last.ckpt", weights_only=True)
    assert stored["steps"] == card["steps"] + 1
    rows = stored["callbacks"]["LearningCurve"]["rows"]
    assert rows[: len(card["curve"])] == card["curve"]


def test_a_killed_lease_leaves_whole_weights(leases, tmp_path):
    assert leases.codes["killed"] == -signal.SIGKILL
    made, lost = export.join_exports(leases.home / "killed.out", tmp_path)
    assert made and not lost, "two generations fit"
    card = files.read_card(tmp_path / "lf3x3.safetensors")
    assert card["steps"] >= 1 and files.load(tmp_path / "lf3x3.safetensors").views == 9
    assert "networks" in json.loads((leases.home / "killed.out" / "profile.json").read_text())


def test_a_lease_ends_in_time_whatever_holds_it_up(leases):
    log = leases.logs["hangs"]
    assert leases.codes["hangs"] == 1 and "trained: nothing" in log
    (end,) = (line for line in log.splitlines() if "the lease is over" in line)
    assert 9 <= float(end.split()[1]) <= 11, "three seconds before the end of 12"
