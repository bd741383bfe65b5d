"""Which runs are one group, what its label says, and what is missing or contradicts itself."""

import json

import pytest
import yaml

from src.records import runs
from src.reports.notes import describe_runs
from src.reports.run_groups import find_differing_defaults, group_runs
from tests.reports.runs import write_run, write_sweep


def grouped(*folders):
    return group_runs(runs.find_runs(list(folders)), runs.find_sweeps(list(folders)))


def test_seeds_of_one_setting_are_one_group_whatever_the_folders_are_called(tmp_path):
    for name, experiment, seed in [("z", "lf3x3", 0), ("lf3x3", "single256", 0), ("0", "lf3x3", 1)]:
        write_run(tmp_path / name, experiment, seed)
    keys, found = grouped(tmp_path)
    assert keys == ("experiment",)
    seeds = {group.label: [run.record["seed"] for run in group.runs] for group in found}
    assert seeds == {("lf3x3",): [0, 1], ("single256",): [0]}


def test_what_command_lines_set_and_differs_is_in_the_label_whole(tmp_path):
    for ckpt, turbulence in (("setnet_small", "weak"), ("single256", "strong")):
        choices, overrides = (
            {"turbulence": turbulence},
            (f"ckpt={ckpt}", f"turbulence={turbulence}"),
        )
        asked = {"choices": choices, "overrides": overrides, "settings": {"ckpt": ckpt}}
        write_run(tmp_path / ckpt, "eval", task="eval", **asked)
    keys, found = grouped(tmp_path)
    assert keys == ("turbulence", "ckpt")
    assert {group.label for group in found} == {("weak", "setnet_small"), ("strong", "single256")}


def test_settings_that_differ_with_no_word_of_the_command_line_are_in_the_note(tmp_path):
    for name, width in (("a", 8), ("b", 16)):
        write_run(tmp_path / name, settings={"lr": width / 10, "width": width, "depth": 2})
    keys, found = grouped(tmp_path)
    assert keys == ("lr",) and find_differing_defaults(keys, found) == ["width"]
    assert " Settings differ that no command line names: width." in describe_runs(keys, found)


def test_what_is_averaged_over_is_in_the_note(tmp_path):
    for ckpt in ("a.ckpt", "b.ckpt"):
        write_run(tmp_path / ckpt, settings={"ckpt": ckpt}, task="eval")
    given = runs.find_runs([tmp_path])
    keys, found = group_runs(given, across=("ckpt", "lr"))
    assert describe_runs(keys, found) == " Means are over ckpt: a.ckpt, b.ckpt."


def test_a_missing_job_has_the_label_that_its_run_would_have(tmp_path):
    write_sweep(tmp_path, {"experiment": "x", "seed": "0", "threshold": "[0.1,0.7],0.30,0.2"})
    overrides, settings = ("threshold=0.2",), {"threshold": 0.2}
    write_run(tmp_path / "a", "x", overrides=overrides, settings=settings)
    write_run(tmp_path / "b", "x", overrides=("threshold=1",), settings={"threshold": 1})
    keys, found = grouped(tmp_path)
    assert keys == ("threshold",)
    assert [group.label[0] for group in found] == ["[0.1, 0.7]", "0.3", "0.2", "1"]


def test_the_label_takes_as_few_choices_as_tell_the_groups_apart(tmp_path):
    place = 0
    for optics in ("single", "lf3x3"):
        for lr in ("0.1", "0.2"):
            write_run(
                tmp_path / str(place),
                choices={"optics": optics, "turbulence": "mixed"},
                overrides=(f"optics={optics}", f"lr={lr}"),
                settings={"lr": float(lr), "optics": {"views": optics}},
            )
            place += 1
    keys, found = grouped(tmp_path)
    assert keys == ("optics", "lr")
    assert [group.label for group in found] == [
        ("single", "0.1"),
        ("single", "0.2"),
        ("lf3x3", "0.1"),
        ("lf3x3", "0.2"),
    ]


def test_a_default_asked_for_by_name_is_the_same_group(tmp_path):
    write_run(tmp_path / "a", seed=0, overrides=("lr=0.001",))
    write_run(tmp_path / "b", seed=1)
    assert [len(group.runs) for group in grouped(tmp_path)[1]] == [2]


def test_settings_that_no_command_line_names_part_groups_too(tmp_path):
    write_run(tmp_path / "a", settings={"lr": 0.1})
    write_run(tmp_path / "b", settings={"lr": 0.2})
    keys, found = grouped(tmp_path)
    assert keys == ("lr",) and [group.label for group in found] == [("0.1",), ("0.2",)]


def test_where_and_on_what_machine_it_ran_makes_no_other_cell(tmp_path):
    write_run(tmp_path / "a", seed=0, settings={"data": {"workers": 0}})
    write_run(tmp_path / "b", seed=1, settings={"data": {"workers": 2}, "ckpt": "x.ckpt"})
    assert len(grouped(tmp_path)[1]) == 1


@pytest.mark.parametrize(
    ("weights", "cells"), [("setnet_small", 2), ("net.safetensors", 2), ("x/last.ckpt", 1)]
)
def test_a_training_that_went_on_from_weights_is_another_cell(weights, cells, tmp_path):
    write_run(tmp_path / "a", seed=0)
    folder = write_run(tmp_path / "b", seed=1, settings={"ckpt": weights})
    record = json.loads((folder / "results.json").read_text()) | {"resumed_from": weights}
    (folder / "results.json").write_text(json.dumps(record))
    keys, found = grouped(tmp_path)
    assert len(found) == cells and keys == (("ckpt",) if cells == 2 else ("experiment",))


@pytest.mark.parametrize(
    ("task", "other", "cells"),
    [
        ("train", {"devices": 8}, 2), ("train", {"devices": [0, 3]}, 1),
        ("train", {"devices": 2, "num_nodes": 2}, 2), ("eval", {"devices": 8}, 1),
    ],
)  # fmt: skip
def test_trainings_on_another_number_of_devices_are_another_cell(task, other, cells, tmp_path):
    for seed, trainer in enumerate(({"devices": 2}, other)):
        settings = {"trainer": trainer}
        write_run(tmp_path / str(seed), seed=seed, settings=settings, task=task)
    assert len(grouped(tmp_path)[1]) == cells


@pytest.mark.parametrize(("task", "cells"), [("eval", 1), ("train", 2)])
def test_other_test_clips_are_another_cell_of_trainings_only(task, cells, tmp_path):
    for seed in (0, 1):
        settings = {"data": {"test_seed": seed}}
        write_run(tmp_path / str(seed), seed=seed, settings=settings, task=task)
    assert len(grouped(tmp_path)[1]) == cells


def test_networks_of_several_seeds_on_the_same_clips_are_one_group_across_ckpt(tmp_path):
    for path in ("a.ckpt", "b.ckpt"):
        settings = {"ckpt": path}
        write_run(tmp_path / path, overrides=(f"ckpt={path}",), settings=settings, task="eval")
    assert [group.label for group in grouped(tmp_path)[1]] == [("a.ckpt",), ("b.ckpt",)]
    keys, (group,) = group_runs(runs.find_runs([tmp_path]), across=("ckpt",))
    assert keys == ("experiment",) and len(group.runs) == 2


def test_of_two_runs_of_one_seed_the_newer_counts_and_it_is_said(tmp_path):
    write_run(tmp_path / "b", scores={"ssim": 0.1})
    write_run(tmp_path / "a", scores={"ssim": 0.2})
    (group,) = grouped(tmp_path)[1]
    assert [run.folder.name for run in group.runs] == ["a"]
    assert group.older == 1


def test_jobs_of_the_sweep_without_results_are_missing_in_its_order(tmp_path):
    write_sweep(tmp_path, {"experiment": "single768,single256,lf3x3", "seed": "range(2)"})
    write_run(tmp_path / "0", "lf3x3", 0)
    write_run(tmp_path / "1", "lf3x3", 1)
    write_run(tmp_path / "2", "single256", 1)
    _, found = grouped(tmp_path)
    assert [(group.label[0], len(group.runs), group.missing) for group in found] == [
        ("single768", 0, 2),
        ("single256", 1, 1),
        ("lf3x3", 2, 0),
    ]


def test_what_tells_jobs_apart_is_in_the_label_before_they_have_ended(tmp_path):
    given = {"experiment": "x", "threshold": "0.1,0.7", "method": "a,b", "data.test_seed": "0,1"}
    write_sweep(tmp_path, given | {"seed": "0"})
    for method in "ab":
        asked = ("threshold=0.1", f"method={method}", "data.test_seed=0")
        settings = {"threshold": 0.1, "data": {"test_seed": 0}}
        choices = {"method": method}
        more = {"settings": settings, "overrides": asked, "choices": choices, "task": "eval"}
        write_run(tmp_path / method, "x", **more)
        keys, found = grouped(tmp_path)
        assert keys == ("method", "threshold")
        done = {group.label for group in found if group.runs}
        assert done == {("a", "0.1"), ("b", "0.1")} if method == "b" else {("a", "0.1")}
        assert {group.label for group in found} == {(m, t) for m in "ab" for t in ("0.1", "0.7")}


def test_a_plan_is_the_command_and_its_jobs(tmp_path):
    write_sweep(tmp_path, {"experiment": "a,b", "seed": "range(2)"}, ("budget=hour", "seed=7"))
    (plan,) = runs.find_sweeps([tmp_path])
    assert plan.command == (
        "python -m src.train --config-dir sweeps --config-name table1 budget=hour seed=7"
    )
    assert [set(job) for job in plan.jobs] == [
        {"experiment=a", "seed=7", "budget=hour"},
        {"experiment=b", "seed=7", "budget=hour"},
    ]


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "empty or not finished"), ("{", "whole results"), ('{"schema": 9}', "schema must be")],
)
def test_an_empty_or_broken_run_folder_is_named(content, said, tmp_path):
    folder = write_run(tmp_path / "run")
    if content is None:
        (folder / "results.json").unlink()
    else:
        (folder / "results.json").write_text(content)
    with pytest.raises(ValueError, match=said) as error:
        runs.find_runs([tmp_path / "run"])
    assert str(folder) in str(error.value) and "run" in str(error.value)


@pytest.mark.parametrize("cut", ["a line", "a value", "times", "a score"])
def test_results_that_are_cut_short_are_refused(cut, tmp_path):
    clips = [{"name": f"c{k}", "lpips": 0.5, "ssim": 0.5} for k in range(3)]
    folder = write_run(tmp_path / "run", clips=clips)
    assert len(runs.find_runs([folder])[0].clips) == 3
    table, record = folder / "clips.csv", json.loads((folder / "results.json").read_text())
    lines = table.read_text().splitlines()
    table.write_text("\n".join(lines[:-1] + (["c2,0.5"] if cut != "a line" else [])))
    if cut in ("times", "a score"):
        table.unlink()
        record |= {"latency_ms": {}} if cut == "times" else {"test": {"clips": 3, "lpips": None}}
        (folder / "results.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match="run must hold whole results, got .*results.json: "):
        runs.find_runs([folder])


def test_clips_whose_means_are_not_those_of_the_test_are_refused(tmp_path):
    clips = [{"name": f"c{k}", "lpips": 0.1 * k, "ssim": float("nan")} for k in range(3)]
    folder = write_run(tmp_path / "run", clips=clips)
    assert len(runs.find_runs([folder])) == 1
    table = folder / "clips.csv"
    table.write_text(table.read_text().replace("0.1,", "0.4,"))
    said = r"got .*run/results\.json: clips\.csv has the mean lpips 0\.2, the test 0\.1"
    with pytest.raises(ValueError, match=said):
        runs.find_runs([folder])


def test_tests_and_trainings_that_did_not_end_are_found_outside_sweeps(tmp_path):
    for name in ("done", "half", "other", "sweep/job"):
        task = "simulate" if name == "other" else "eval"
        folder = write_run(tmp_path / name, task=task)
        if name != "done":
            (folder / "results.json").unlink()
    write_sweep(tmp_path / "sweep", {"seed": "0,1"})
    assert runs.find_unfinished_runs([tmp_path]) == [tmp_path / "half"]


def test_results_beside_the_config_of_another_run_are_refused(tmp_path):
    folder = write_run(tmp_path / "run")
    config = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(config.replace("lf3x3", "single256"))
    with pytest.raises(ValueError, match="config.yaml is of another run"):
        runs.find_runs([folder])


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match="no such folder"):
        runs.find_runs([tmp_path / "nowhere"])


def test_evaluations_of_other_test_seeds_all_count(tmp_path):
    for seed in (0, 1, 2):
        more = {"settings": {"data": {"test_seed": seed}}, "task": "eval"}
        write_run(tmp_path / str(seed), overrides=(f"data.test_seed={seed}",), **more)
    _, (group,) = grouped(tmp_path)
    assert len(group.runs) == 3 and group.older == 0


def test_a_sweep_of_another_folder_is_printed_with_it(tmp_path):
    write_sweep(tmp_path, {"seed": "0,1"})
    file = tmp_path / "multirun.yaml"
    hydra = yaml.safe_load(file.read_text())
    source = {"path": "/home/me/mine/sweeps", "provider": "command-line"}
    hydra["hydra"]["runtime"] = {"cwd": "/home/me", "config_sources": [source]}
    file.write_text(yaml.safe_dump(hydra))
    (plan,) = runs.find_sweeps([tmp_path])
    assert plan.command == "python -m src.train --config-dir mine/sweeps --config-name table1"
