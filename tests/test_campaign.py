"""Campaigns of tiny fake trainings: in turn, two at a time, through kills of anybody."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from scripts import campaign
from scripts.campaign_training import ROOT, Training

# Steps of 0.02 s, each with a checkpoint (a text file with the number of steps); as src.train, it
# goes on from `ckpt=`, writes a curve, and at the end its results.
FAKE = """
import pathlib, sys, time
folder, hours, *rest = sys.argv[1:]
run, all = pathlib.Path(folder), pathlib.Path(folder).parent
(run / "checkpoints").mkdir(parents=True)
(run / "config.yaml").write_text(f"hours: {hours}\\n")
steps = max([int(p.read_text()) for p in all.rglob("*.ckpt")], default=0) if rest else 0
fault = (all.parent / "fault.py").read_text() if (all.parent / "fault.py").is_file() else ""
while steps < 10 * float(hours):
    time.sleep(0.02)
    steps += 1
    (run / "checkpoints" / "last.ckpt").write_text(str(steps))
    with (all.parent / "order.txt").open("a") as file:
        file.write(f"{all.name} {steps}\\n")
    rows = "".join(f"{n / 10},{n},{0.5 if n > 5 else 1 - n / 10}\\n" for n in range(steps + 1))
    (run / "curve.csv").write_text("hours,steps,lpips\\n" + rows)
    exec(fault)
(run / "results.json").write_text("{}")
"""


@pytest.fixture(autouse=True)
def fakes(monkeypatch):
    real = Training.command

    def command(self) -> list[str]:
        words = real(self)
        (folder,) = (word.split("=", 1)[1] for word in words if word.startswith("hydra.run.dir"))
        rest = [word for word in words if word.startswith("ckpt=")]
        return [sys.executable, "-c", FAKE, folder, str(self.hours), *rest]

    monkeypatch.setattr(Training, "command", command)
    monkeypatch.setattr(campaign, "POLL_S", 0.05)
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


def plan(folder: Path, *names: str, hours: float = 1, **more) -> Path:
    rows = [f"  - {{name: {name}, hours: {hours}}}" for name in names]
    values = {"out": folder, "export": folder / "now", "common": "[a=b]", "at_once": 2}
    values |= {"threads": 1, "nice": 0, "tries": 3, "stop": "null"} | more
    head = [f"{key}: {value}" for key, value in values.items()]
    path = folder / "plan.yaml"
    folder.mkdir(exist_ok=True)
    path.write_text("\n".join([*head, "trainings:", *rows]))
    return path


def order(folder: Path) -> list[tuple[str, int]]:
    lines = (folder / "order.txt").read_text().split("\n")[:-1]
    return [(line.split()[0], int(line.split()[1])) for line in lines]


def states(path: Path) -> list[str]:
    return [one.state() for one in campaign.load(path)[1]]


def test_two_at_a_time_and_in_turn(tmp_path):
    path = plan(tmp_path, "a", "b", "c")
    lines = "(all.parent / 'order.txt').read_text().split()"
    # The first step waits for a second training, for five seconds at most.
    (tmp_path / "fault.py").write_text(f"""
for _ in range(500):
    if steps > 1 or len(set({lines}[::2])) > 1: break
    time.sleep(0.01)""")
    assert campaign.run(*campaign.load(path)) == 0
    assert states(path) == ["done"] * 3
    done = order(tmp_path)
    first_of = {name: [n for n, _ in done].index(name) for name in "abc"}
    last_of = {name: len(done) - 1 - [n for n, _ in done][::-1].index(name) for name in "abc"}
    assert first_of["b"] < last_of["a"] and first_of["a"] < last_of["b"]
    assert first_of["c"] > min(last_of["a"], last_of["b"])
    assert [steps for name, steps in done if name == "c"] == list(range(1, 11))


def test_a_killed_training_goes_on_from_its_checkpoint(tmp_path):
    path = plan(tmp_path, "a")
    kill = "if steps in (3, 6, 8): __import__('os').kill(__import__('os').getpid(), 9)"
    (tmp_path / "fault.py").write_text(kill)
    assert campaign.run(*campaign.load(path)) == 0
    assert [steps for _, steps in order(tmp_path)] == list(range(1, 11))
    assert len(list((tmp_path / "a").glob("part*"))) == 4
    kept = [file.parts[-3] for file in (tmp_path / "a").rglob("*.ckpt")]
    assert sorted(kept) == ["part001", "part002", "part003"], "older checkpoints go"


def test_more_hours_go_on_where_it_ended(tmp_path):
    campaign.run(*campaign.load(plan(tmp_path, "a")))
    longer = plan(tmp_path, "a", hours=2)
    assert states(longer) == ["waiting"]
    campaign.run(*campaign.load(longer))
    assert [steps for _, steps in order(tmp_path)] == list(range(1, 21))


def test_a_training_outlives_its_campaign_and_is_found_again(tmp_path):
    path = plan(tmp_path, "a", hours=15)
    training = campaign.load(path)[1][0]
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r})\n" + (
        "from tests.test_campaign import campaign, Training, FAKE\n"
        "from pathlib import Path\n"
        "Training.command = lambda self: [sys.executable, '-c', FAKE, "
        "str(self.folder / 'part000'), str(self.hours)]\n"
        f"campaign.run(*campaign.load(Path({str(path)!r})))"
    )
    boss = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    until(lambda: (tmp_path / "order.txt").is_file())
    boss.kill()
    boss.wait()
    assert training.state() == "running"
    assert campaign.run(*campaign.load(path)) == 0
    assert [steps for _, steps in order(tmp_path)] == list(range(1, 151))
    assert len(list((tmp_path / "a").glob("part*"))) == 1


def test_a_campaign_that_is_stopped_stops_its_trainings(tmp_path):
    path = plan(tmp_path, "a", hours=50)
    until_started = "import os, pathlib; os.kill(os.getppid(), 15) if steps == 3 else None"
    (tmp_path / "fault.py").write_text(until_started)
    with pytest.raises(SystemExit) as stopped:
        campaign.run(*campaign.load(path))
    assert stopped.value.code == 128 + signal.SIGTERM
    assert states(path) == ["waiting"] and order(tmp_path)[-1][1] < 200


def test_what_gains_nothing_more_ends_early(tmp_path):
    path = plan(tmp_path, "a", hours=5, stop="{hours: 0.5, gain: 0.005}")
    assert campaign.run(*campaign.load(path)) == 0
    assert states(path) == ["stopped"]
    assert 10 <= order(tmp_path)[-1][1] < 50, "LPIPS falls until 0.6 h"


def test_what_fails_thrice_is_given_up_and_the_others_go_on(tmp_path):
    path = plan(tmp_path, "a", "b", at_once=1)
    fail = "if all.name == 'a': (run / 'checkpoints/last.ckpt').unlink(); sys.exit('error: no')"
    (tmp_path / "fault.py").write_text(fail)
    assert campaign.run(*campaign.load(path)) == 1
    assert states(path) == ["failed", "done"]
    assert (tmp_path / "a" / "failed.txt").read_text() == "exit code 1: error: no\n"
    assert len(list((tmp_path / "a").glob("part*"))) == 3


def test_status_says_how_far_each_is(tmp_path):
    training = campaign.load(plan(tmp_path, "a", hours=4))[1][0]
    assert training.line() == "a: waiting, 0.00 of 4 h, 0 steps"
    checkpoints = training.folder / "part000" / "checkpoints"
    checkpoints.mkdir(parents=True)
    torch.save({"seconds": 5400.0, "global_step": 77}, checkpoints / "last.ckpt")
    rows = "hours,steps,loss,lpips,wobble\n0,0,,0.7,1\n1.0,50,0.9,0.4321,1.2\n"
    (training.folder / "part000" / "curve.csv").write_text(rows)
    wanted = "a: waiting, 1.50 of 4 h, 77 steps, stored 0 min ago; at hours 1, lpips 0.4321, "
    assert training.line() == wanted + "wobble 1.2"


def test_only_one_campaign_works_in_a_folder(tmp_path):
    path = plan(tmp_path, "a")
    with (tmp_path / "campaign.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="out must be a folder that no campaign works in"):
            campaign.run(*campaign.load(path))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("at_once: 0", "at_once must be a whole number in 1..64"),
        ("nice: 25", "nice must be"),
        ("trainings: [{name: a, hours: -1}]", "hours of a must be > 0"),
        ("trainings: [{name: a, hours: 1}, {name: a, hours: 2}]", "names of their own"),
        ("strange: 1", "must be as conf/campaign/default.yaml"),
        ("trainings: []", "names of their own"),
    ],
)
def test_a_wrong_plan_is_named(text, said, tmp_path):
    path = plan(tmp_path, "a")
    key = text.split(":")[0]
    lines = [line for line in path.read_text().splitlines() if not line.startswith((key, "  -"))]
    rows = [] if key == "trainings" else ["  - {name: a, hours: 1}"]
    path.write_text("\n".join([text, *lines, *rows]))
    with pytest.raises(ValueError, match=said):
        campaign.load(path)


def until(seen) -> None:
    end = time.monotonic() + 60
    while not seen():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


def test_the_real_command_is_one_of_src_train(monkeypatch, tmp_path):
    monkeypatch.undo()
    training = campaign.load(ROOT / "conf" / "campaign" / "default.yaml")[1][0]
    words = training.command()
    assert "campaign-child" in " ".join(words) and "experiment=lf3x3" in words
    assert words[:3] == ["nice", "-n", "19"] and os.access(words[3], os.X_OK)
