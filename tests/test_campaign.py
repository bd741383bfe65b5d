"""Campaigns: recipes of tiny fake trainings, two at a time, stage by stage, through kills."""

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from scripts.campaign import __main__ as campaign
from scripts.campaign import driver
from scripts.campaign.recipe import ROOT, names, read
from scripts.campaign.training import Settings, Training, give_way
from scripts.campaign.work import RecipeWork, average
from src.models import files
from src.models.e2vid import E2VID

# Steps of 0.02 s, each with a checkpoint (a text file with the number of steps); as src.train, it
# goes on from `ckpt=`, and writes weights and results at the end.
FAKE = """
import json, pathlib, struct, sys, time
folder, hours, *rest = sys.argv[1:]
run, all = pathlib.Path(folder), pathlib.Path(folder).parent
(run / "checkpoints").mkdir(parents=True)
(run / "config.yaml").write_text(f"train_hours: {hours}\\n")
steps = max([int(p.read_text()) for p in all.rglob("*.ckpt")], default=0) if rest else 0
top = all.parent.parent
fault = (top / "fault.py").read_text() if (top / "fault.py").is_file() else ""
while steps < 10 * float(hours):
    time.sleep(0.02)
    steps += 1
    (run / "checkpoints" / "last.ckpt").write_text(str(steps))
    with (top / "order.txt").open("a") as file:
        file.write(f"{all.parent.name} {steps}\\n")
    exec(fault)
header = json.dumps({"__metadata__": {"network": "{}", "card": "{}"}}).encode()
all.with_suffix(".safetensors").write_bytes(struct.pack("<Q", len(header)) + header)
(run / "results.json").write_text("{}")
"""


@pytest.fixture
def fakes(monkeypatch):
    real = Training.command

    def command(self, overrides, start) -> list[str]:
        words = real(self, overrides, start)
        (folder,) = (word.split("=", 1)[1] for word in words if word.startswith("hydra.run.dir"))
        rest = [word for word in words if word.startswith("ckpt=")]
        return [sys.executable, "-c", FAKE, folder, str(self.hours), *rest]

    def ship(self, stage) -> None:
        self.shipped.parent.mkdir(exist_ok=True)
        self.shipped.write_text(stage.name)

    monkeypatch.setattr(Training, "command", command)
    monkeypatch.setattr(RecipeWork, "_ship", ship)
    monkeypatch.setattr(driver, "POLL_S", 0.05)
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


def works(folder: Path, *given: str, hours: float = 1, parallel: int = 2) -> list[RecipeWork]:
    """One recipe with one training for each name."""
    settings = Settings(folder, parallel, 1, 0, 3)
    return [RecipeWork(recipe(folder, name, hours), settings) for name in given]


def recipe(folder: Path, name: str, hours: float = 1, stages: str | None = None):
    path = folder / f"{name}.yaml"
    stages = stages or f"[{{name: training, hours: {hours}}}]"
    path.write_text(f"experiment: lf3x3\nstages: {stages}\n")
    return read(str(path))


def run(given: list[RecipeWork]) -> int:
    return driver.run(given[0].settings, given)


def order(folder: Path) -> list[tuple[str, int]]:
    lines = (folder / "order.txt").read_text().split("\n")[:-1]
    return [(line.split()[0], int(line.split()[1])) for line in lines]


def test_two_at_a_time_and_in_turn(tmp_path, fakes):
    lines = "(top / 'order.txt').read_text().split()"
    # The first step waits for a second training, for five seconds at most.
    (tmp_path / "fault.py").write_text(f"""
for _ in range(500):
    if steps > 1 or len(set({lines}[::2])) > 1: break
    time.sleep(0.01)""")
    given = works(tmp_path, "a", "b", "c")
    assert run(given) == 0
    assert [work.state() for work in given] == ["done"] * 3
    done = order(tmp_path)
    first_of = {name: [n for n, _ in done].index(name) for name in "abc"}
    last_of = {name: len(done) - 1 - [n for n, _ in done][::-1].index(name) for name in "abc"}
    assert first_of["b"] < last_of["a"] and first_of["a"] < last_of["b"]
    assert first_of["c"] > min(last_of["a"], last_of["b"])
    assert [steps for name, steps in done if name == "c"] == list(range(1, 11))


def test_a_killed_training_goes_on_from_its_checkpoint(tmp_path, fakes):
    kill = "if steps in (3, 6, 8): __import__('os').kill(__import__('os').getpid(), 9)"
    (tmp_path / "fault.py").write_text(kill)
    assert run(works(tmp_path, "a")) == 0
    assert [steps for _, steps in order(tmp_path)] == list(range(1, 11))
    folder = tmp_path / "a" / "training"
    assert len(list(folder.glob("part*"))) == 4
    kept = [file.parts[-3] for file in folder.rglob("*.ckpt")]
    assert sorted(kept) == ["part001", "part002", "part003"], "older checkpoints go"


def test_stages_run_in_order_and_go_on_from_each_other(tmp_path, fakes):
    stages = "[{name: short, hours: 0.3}, {name: long, hours: 0.5, seed: 4, overrides: [x=1]}]"
    work = RecipeWork(recipe(tmp_path, "a", stages=stages), Settings(tmp_path, 1, 1, 0, 3))
    assert run([work]) == 0
    assert [steps for _, steps in order(tmp_path)] == [1, 2, 3, 1, 2, 3, 4, 5]
    assert work.shipped.read_text() == "long"
    second = work.recipe.stages[1]
    assert work._start(second) == str((tmp_path / "a" / "short.safetensors").resolve())
    assert work._overrides(second) == ["experiment=lf3x3", "seed=4", "x=1"]


def test_a_recipe_waits_for_the_networks_that_it_names(tmp_path, fakes):
    first, second = works(tmp_path, "a", "b")
    stage = second.recipe.stages[0]._replace(overrides=["teachers=[{a}]"])
    second.recipe = second.recipe._replace(after=["a"], stages=[stage])
    assert run([second, first]) == 0
    assert [name for name, _ in order(tmp_path)] == ["a"] * 10 + ["b"] * 10
    taught = f"teachers=[{tmp_path / 'weights' / 'a.safetensors'}]"
    assert taught in second._overrides(stage)
    whole, shipped = tmp_path / "whole", recipe(tmp_path, "d")._replace(after=["lf3x3"])
    whole.mkdir()
    given = [RecipeWork(shipped, Settings(whole, 2, 1, 0, 3)), *works(whole, "lf3x3")]
    assert run(given) == 0, "one of this campaign comes before the shipped one of its name"
    assert [name for name, _ in order(whole)] == ["lf3x3"] * 10 + ["d"] * 10
    (alone,) = works(tmp_path / "..", "c")
    alone.recipe = alone.recipe._replace(after=["nothing"])
    with pytest.raises(ValueError, match="c needs the networks nothing: train them too"):
        run([alone])


def test_a_training_outlives_its_campaign_and_is_found_again(tmp_path, fakes):
    given = works(tmp_path, "a", hours=15)
    training = given[0].trainings["training"]
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r})\n" + (
        "from pathlib import Path\nfrom scripts.campaign import driver\n"
        "from tests.test_campaign import FAKE, Training, works\n"
        "Training.command = lambda self, *_: [sys.executable, '-c', FAKE, "
        "str(self.folder / 'part000'), str(self.hours)]\n"
        f"given = works(Path({str(tmp_path)!r}), 'a', hours=15)\n"
        "driver.run(given[0].settings, given)"
    )
    boss = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    until(lambda: (tmp_path / "order.txt").is_file())
    boss.kill()
    boss.wait()
    assert training.state() == "running"
    assert run(given) == 0
    assert [steps for _, steps in order(tmp_path)] == list(range(1, 151))
    assert len(list(training.folder.glob("part*"))) == 1


def test_a_campaign_that_is_stopped_stops_its_trainings(tmp_path, fakes):
    until_started = "import os, pathlib; os.kill(os.getppid(), 15) if steps == 3 else None"
    (tmp_path / "fault.py").write_text(until_started)
    given = works(tmp_path, "a", hours=50)
    with pytest.raises(SystemExit) as stopped:
        run(given)
    assert stopped.value.code == 128 + signal.SIGTERM
    assert given[0].state() == "waiting" and order(tmp_path)[-1][1] < 200


def test_what_fails_thrice_is_given_up_and_the_others_go_on(tmp_path, fakes):
    fail = "if all.parent.name == 'a': (run / 'checkpoints/last.ckpt').unlink(); sys.exit('no')"
    (tmp_path / "fault.py").write_text(fail)
    given = works(tmp_path, "a", "b", parallel=1)
    assert run(given) == 1
    assert [work.state() for work in given] == ["failed", "done"]
    failed = tmp_path / "a" / "training" / "failed.txt"
    assert failed.read_text() == "exit code 1: no\n"
    why = f"; exit code 1: no; log: {tmp_path / 'a' / 'training' / 'log.txt'}"
    assert given[0].line().endswith(why) and "failed" not in given[1].line()
    assert len(list((tmp_path / "a" / "training").glob("part*"))) == 3


def test_what_has_failed_is_tried_again_by_a_new_start(tmp_path, fakes):
    fault = tmp_path / "fault.py"
    fault.write_text("sys.exit(2)")
    assert run(works(tmp_path, "a")) == 1
    assert len(list((tmp_path / "a" / "training").glob("part*"))) == 1, "a wrong value stays wrong"
    fault.unlink()
    given = works(tmp_path, "a")
    assert given[0].state() == "failed" and run(given) == 0 and given[0].state() == "done"


def test_results_without_weights_are_not_done(tmp_path, fakes):
    (work,) = works(tmp_path, "a")
    assert run([work]) == 0
    (training,) = work.trainings.values()
    training.weights.unlink()
    assert training.state() == "waiting"


def test_a_look_at_a_training_does_not_stop_its_start(tmp_path, fakes):
    (work,) = works(tmp_path, "a")
    (training,) = work.trainings.values()
    training.folder.mkdir(parents=True)
    with (training.folder / "lock").open("a") as look:
        fcntl.flock(look, fcntl.LOCK_SH)
        assert not training.running(), "two may look at once"
        threading.Timer(0.3, fcntl.flock, (os.dup(look.fileno()), fcntl.LOCK_UN)).start()
        training.start([], None)
    assert training.running()
    training.process.wait()


def test_a_start_says_which_stage_and_how_far(tmp_path, fakes, capsys):
    assert run(works(tmp_path, "a")) == 0
    assert (
        capsys.readouterr()
        .out.split("\n")[0]
        .endswith(" a: running, training, 0.00 of 1 h, 0 steps")
    )


def test_status_says_how_far_each_is(tmp_path):
    (work,) = works(tmp_path, "a", hours=4)
    assert work.line() == "a: waiting, training, 0.00 of 4 h, 0 steps"
    part = tmp_path / "a" / "training" / "part000"
    (part / "checkpoints").mkdir(parents=True)
    torch.save({"seconds": 5400.0, "global_step": 77}, part / "checkpoints" / "last.ckpt")
    rows = "hours,steps,loss,lpips,temporal_jitter_px\n0,0,,0.7,1\n1.0,50,0.9,0.4321,1.2\n"
    (part / "curve.csv").write_text(rows)
    wanted = "a: waiting, training, 1.50 of 4 h, 77 steps, stored 0 min ago; at hours 1, "
    assert work.line() == wanted + "lpips 0.4321, temporal_jitter_px 1.2"


def test_only_one_campaign_works_in_a_folder(tmp_path, fakes):
    with (tmp_path / "campaign.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="out must be a folder that no campaign works in"):
            run(works(tmp_path, "a"))


@pytest.mark.parametrize(
    ("stages", "said"),
    [
        ("[{name: a, hours: -1}]", r"hours of stage a of recipe r must be in \(0, 10000\), got -1"),
        ("[{name: a, hours: 1}, {name: a, hours: 2}]", "stage a of recipe r must have a name of"),
        ("[{name: a}]", "stage a of recipe r must have one of hours, widen and mean"),
        ("[{name: a, hours: 1}, {name: b, mean: {a: 0.4}}]", "mean of stage b of recipe r must"),
        ("[{name: a, mean: {b: 1}}, {name: b, hours: 1}]", "among stages before it"),
        ("[{name: a, hours: 1, speed: 2}]", "must be of the form of conf/recipe/lf3x3.yaml"),
        ("[]", "recipe r must have stages"),
        ("[{name: a, hours: '2'}]", "hours of stage a of recipe r must be a number, got '2'"),
        ("[{name: a, hours: true}]", "hours of stage a of recipe r must be a number, got True"),
        ("[{name: a, hours: 1, seed: 0.5}]", "seed of stage a .* must be a whole number, got 0.5"),
        ("[{name: a, hours: 1, overrides: x=1}]", "overrides of stage a .* a list of texts, got"),
        ("[{name: a, hours: 1, start: [b]}]", "start of stage a of recipe r must be text, got"),
        ("[{name: a, hours: 1}, {name: b, mean: {a: x}}]", "mean of stage b .* with numbers, got"),
        ("[{name: a, hours: 2}, {name: b, hours: 2}]", "hours of stage b .* above the 2 of what"),
        ("[{name: a, hours: 2}, {name: b, mean: {a: 1}}, {name: c, hours: 1}]", "above the 2 of"),
        ("[{name: a, hours: 1]", "r.yaml must be of the form of conf/recipe/lf3x3.yaml"),
        ("[{name: a, hours: 1}]\noverrides: x=1", "overrides of recipe r must be a list of texts"),
        ("[{name: a, hours: 1}]\nafter: lf3x3", "after of recipe r must be a list of texts, got"),
        ("[{name: a, hours: 1}]\noverrides: null", "overrides of recipe r must be a list of"),
    ],
)
def test_a_wrong_recipe_is_named(stages, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        recipe(tmp_path, "r", stages=stages)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "recipe must be one or more of clean/e2vid_plus, .*, got none"),
        (["lf4x4"], "recipe must be one of .*, got lf4x4"),
        (["lf3x3", "nice=25"], r"nice must be a whole number in 0\.\.19, got 25"),
        (["lf3x3", f"clone={ROOT / 'docs'}"], "clone must be a new folder or a clone of this"),
        (["lf3x3", "clone=/dev/null/x"], "clone must be a folder to make, got /dev/null/x: fatal"),
        (["clean/etnet", "scene.rot=x"], "stage short_sequences of recipe clean/etnet: .*rot"),
    ],
)
def test_a_wrong_command_line_is_named(words, said, monkeypatch):
    monkeypatch.setattr(campaign, "git_commit", lambda: "abc")
    with pytest.raises(ValueError, match=said):
        campaign.run(words)


def test_an_experiment_that_is_none_is_named_before_anything_is_started(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "git_commit", lambda: "abc")
    (tmp_path / "r.yaml").write_text("experiment: nosuch\nstages: [{name: a, hours: 1}]\n")
    with pytest.raises(ValueError, match="stage a of recipe r: .*nosuch"):
        campaign.run([str(tmp_path / "r.yaml"), f"out={tmp_path / 'out'}"])
    assert not (tmp_path / "out").exists()


def test_hours_are_above_those_of_the_network_that_is_widened(tmp_path):
    campaign.check_hours([read(name) for name in names()])
    campaign.check_hours([read("setnet_large")])
    medium, large = read("setnet_medium"), read("setnet_large")
    longer = medium.stages[-2]._replace(hours=29)
    medium = medium._replace(stages=[*medium.stages[:-2], longer, medium.stages[-1]])
    said = "hours of stage distillation of recipe setnet_large must be above the 29 of"
    with pytest.raises(ValueError, match=said):
        campaign.check_hours([large, medium])


def test_paths_are_those_of_the_folder_that_a_campaign_is_started_in(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("photos", "more", "clone/scripts/campaign"):
        (tmp_path / folder).mkdir(parents=True)
    started = []
    monkeypatch.setattr(os, "execv", lambda _, words: started.append(words[3:]))
    monkeypatch.setattr(campaign, "names", lambda: ["lf3x3"])
    words = ["tiny.yaml", "lf3x3", "clone=clone", "out=here", "scene.root=photos"]
    words += ["scene.extra_train_root=[photos,more]", "teachers=[lf3x3,single256]", "width=8"]
    (tmp_path / "tiny.yaml").write_text("experiment: lf3x3\nstages: [{name: a, hours: 1}]\n")
    campaign.run([*words, "status"])
    assert started == [[
        f"{tmp_path}/tiny.yaml", "lf3x3", f"out={tmp_path}/here", f"scene.root={tmp_path}/photos",
        f"scene.extra_train_root=[{tmp_path}/photos,{tmp_path}/more]",
        "teachers=[lf3x3,single256]", "width=8", "status",
    ]]  # fmt: skip


def test_a_campaign_runs_at_a_commit(monkeypatch, tmp_path):
    monkeypatch.setattr(campaign, "git_commit", lambda: "abc-dirty")
    with pytest.raises(ValueError, match="a campaign runs at a commit, got abc-dirty"):
        campaign.run(["lf3x3", f"out={tmp_path}"])
    assert campaign.run(["lf3x3", f"out={tmp_path}", "status"]) == 0


def test_a_mean_of_weights_is_weighted(tmp_path):
    arguments = {"views": 1, "bins": 5, "base_channels": 2}
    spec, shares = {"target": "src.models.e2vid.E2VID", "kwargs": arguments}, {}
    for value, share in ((1.0, 0.25), (3.0, 0.75)):
        network = E2VID(**arguments)
        for parameter in network.parameters():
            torch.nn.init.constant_(parameter, value)
        path = tmp_path / f"{share}.safetensors"
        files.save(path, network, spec, {"hours": value})
        shares[path] = share
    average(shares, tmp_path / "mean.safetensors")
    mean = files.load(tmp_path / "mean.safetensors")
    assert all(bool((parameter == 2.5).all()) for parameter in mean.parameters())
    card = files.read_card(tmp_path / "mean.safetensors")
    assert card == {"hours": 3.0, "mean_of": {"0.25": 0.25, "0.75": 0.75}}


@pytest.mark.parametrize("name", ["lf3x3", "clean/etnet"])
def test_weights_are_shipped_to_where_the_recipe_looks_for_them(name, tmp_path, monkeypatch):
    given = ["+scene.root=/data/photos", "width=8"]
    work, words = RecipeWork(read(name), Settings(tmp_path, overrides=given)), []
    monkeypatch.setattr("scripts.campaign.work.run", lambda module, *given: words.extend(given))
    for stage in work.recipe.stages:
        path = work.folder / f"{stage.name}.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    work._ship(work.recipe.stages[-1])
    options = dict(zip(words[1::2], words[2::2], strict=True))
    assert Path(options["--to"]) / f"{options['--name']}.safetensors" == work.shipped
    assert options["--recipe"] == f"{name}, width=8"


def test_a_training_gives_way_to_other_sessions(tmp_path):
    sleeper = subprocess.Popen(["sleep", "60"], start_new_session=True)
    group = Path(f"/proc/{sleeper.pid}/autogroup")
    give_way(sleeper.pid, 19)
    if group.is_file():
        assert group.read_text().split()[-1] == "19"
    sleeper.kill()
    sleeper.wait()
    give_way(sleeper.pid, 19)  # one that has ended is nothing to mind


def until(seen) -> None:
    end = time.monotonic() + 60
    while not seen():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


def test_the_command_of_a_training_is_one_of_src_train(tmp_path):
    given = ("scene.root=x", "seed=7", "loss.l1.weight=2")
    work = RecipeWork(read("lf3x3"), Settings(tmp_path, overrides=given))
    assert work._overrides(work.recipe.stages[-1])[-3:] == list(given), "above those of a stage"
    stage = work.recipe.stages[0]
    words = work.trainings[stage.name].command(work._overrides(stage), None)
    assert "campaign-child" in " ".join(words) and "experiment=lf3x3" in words
    assert "scene.root=x" in words
    assert "trainer.enable_progress_bar=false" in words, "no bar, not Lightning's own either"
    assert words[:3] == ["nice", "-n", "19"] and os.access(words[3], os.X_OK)


def configs(name: str, folder: Path) -> list[DictConfig]:
    """Those of the stages of a recipe, in order."""
    work = RecipeWork(read(name), Settings(folder))
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        return [
            compose("train", [word.replace("{", "").replace("}", "") for word in overrides])
            for overrides in map(work._overrides, work.recipe.stages)
        ]


@pytest.mark.parametrize("name", names())
def test_a_recipe_is_of_configs_and_shows_what_the_shipped_network_was_shown(name, tmp_path):
    recipe, stages = read(name), configs(name, tmp_path)
    for stage, cfg in zip(recipe.stages, stages, strict=True):
        assert cfg.seed == stage.seed and cfg.name == recipe.experiment
    card, cfg = files.read_card(files.WEIGHTS / f"{name}.safetensors"), stages[-1]
    kind = card["scenes"].split(",")[0]
    assert cfg.scene["_target_"].endswith(f".{kind}") and cfg.optics.views == card["views"]
    if kind == "Photographs":  # of a time without drawn sensors and losses of several windows
        assert not cfg.sensor.random and cfg.loss.temporal_consistency.weight == 0


def test_every_shipped_network_has_a_recipe():
    shipped = {str(f.relative_to(files.WEIGHTS)) for f in files.WEIGHTS.rglob("*.safetensors")}
    assert shipped == {f"{name}.safetensors" for name in names()}


TINY = [
    "scene=photos", "scene.height=64", "scene.width=64", "data.windows=8", "data.crop=32",
    "data.loss_pairs=2", "data.loss_from=2", "data.batch_size=2", "data.train_clips=null",
    "data.cache_clips=null", "data.batch_reuse=1", "data.val_clips=1", "data.test_clips=1",
    "data.test_windows=8", "data.unscored_windows=1", "callbacks.learning_curve.interval_h=0.001",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", names())
def test_each_recipe_runs_from_nothing_to_its_card(name, tmp_path, monkeypatch):
    commit_of(tmp_path / "repository", monkeypatch)
    full = read(name)
    own = [o for o in full.overrides if not o.startswith(("scene.", "sensor.", "~sensor"))]
    widened = full.stages[0].widen
    begun = files.read_card(files.WEIGHTS / f"{widened}.safetensors")["hours"] if widened else 0
    stages = [
        stage._replace(
            hours=stage.hours and begun + 0.0015 * (place + 1),
            overrides=[o for o in stage.overrides if o.startswith(("teachers", "loss", "optics"))],
        )
        for place, stage in enumerate(full.stages)
    ]
    work = RecipeWork(
        full._replace(overrides=own, stages=stages), Settings(tmp_path / "out", overrides=TINY)
    )
    monkeypatch.setattr(driver, "POLL_S", 0.5)
    assert run([work]) == 0, (work.folder / full.stages[0].name / "log.txt").read_text()
    assert work.state() == "done" and files.load(work.shipped).eval()
    card = work.shipped.with_suffix(".md").read_text()
    assert f"| recipe | [{name}](" in card and "-dirty" not in card


def commit_of(folder: Path, monkeypatch) -> None:
    """Let the trainings see a repository without changes, whatever this one has."""
    git = ["git", "-c", "user.name=t", "-c", "user.email=t@t", "-C", str(folder)]
    subprocess.run(["git", "init", "-q", str(folder)], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "t"], check=True)
    monkeypatch.setenv("GIT_DIR", str(folder / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(folder))
