"""What runs are ahead of others by, clip by clip."""

import math
import os
import shutil
from dataclasses import replace

import pytest

from src.records import runs
from src.report import report
from src.reports import run_groups
from src.reports.differences import build_difference_table, compare_clips, pool_same_clips
from src.reports.pairs import build_pair_table
from src.reports.tables import METRICS, TableCell
from src.reports.writers import format_cell, format_csv_tables, format_markdown
from tests.reports.runs import SCORES, write_run, write_sweep
from tests.test_train import config

PAPER = {"source": "paper", "rows": [
    {"when": {"experiment": "lf3x3"}, "lpips": 0.43}, {"when": {"experiment": "one"}, "lpips": 0.46}
]}  # fmt: skip


def found(
    folder, experiment: str, *clips: dict[str, float], have_own_clips: bool = False
) -> list[runs.Run]:
    for seed, values in enumerate(clips):
        rows = [SCORES | {"name": name, "lpips": value} for name, value in values.items()]
        settings = {"data": {"test_seed": seed if have_own_clips else 0}}
        write_run(folder / experiment / str(seed), experiment, seed, clips=rows, settings=settings)
    return runs.find_runs([folder / experiment])


def test_differences_are_ours_minus_theirs_with_an_interval(tmp_path):
    ours = found(tmp_path, "lf3x3", {"a": 2.0, "b": 5.0}, {"a": 2.0, "b": 5.0})
    theirs = found(tmp_path, "one", {"a": 1.0, "b": 4.0})
    table = build_difference_table("Clip by clip", ours, theirs, PAPER)
    assert [value.text for value in table.rows[0]] == [
        "LPIPS", "3.5000", "2.5000", "+1.0000", "+1.0000 to +1.0000", "-0.0300"
    ]  # fmt: skip
    assert table.rows[1][-1].text == "-"


@pytest.mark.parametrize("other", ["cd", "ef"])  # photographs of another seed have other names
def test_clips_of_other_seeds_are_further_clips(other, tmp_path):
    """Not the same clips in another training, of which the means vary independently."""
    values = {"a": ((2.0, 5.0), (1.0, 9.0)), "b": ((1.0, 4.0), (0.0, 8.0))}
    ours, theirs = (
        found(tmp_path, side, dict(zip("cd", first, strict=True)),
              dict(zip(other, second, strict=True)), have_own_clips=True)
        for side, (first, second) in values.items()
    )  # fmt: skip
    table = build_difference_table("", ours, theirs, PAPER)
    assert table.rows[0][3].text == "+1.0000" and table.rows[0][4].text == "+1.0000 to +1.0000"
    assert table.note.startswith("4 clips; 2 runs against 2.")
    theirs[1].clips[0]["name"] = "another"
    with pytest.raises(ValueError, match="must hold the same clips, got 2 sets"):
        build_difference_table("", ours, theirs, PAPER)


def test_clips_of_a_seed_that_one_side_lacks_are_left_out_and_it_is_said(tmp_path):
    ours = found(tmp_path, "a", {"c": 2.0, "d": 5.0}, {"c": 9.0, "d": 9.0}, have_own_clips=True)
    theirs = found(tmp_path, "b", {"c": 1.0, "d": 4.0}, {"c": 0.0, "d": 8.0}, have_own_clips=True)
    said = "Left out: clips of seed 1, which one side lacks."
    table = build_difference_table("", ours, theirs[:1], PAPER)
    assert table.rows[0][3].text == "+1.0000"
    assert table.note.startswith(f"2 clips; 1 runs against 1. {said}")
    tests = [replace(r, record=r.record | {"task": "eval"}) for r in (*ours, *theirs[:1])]
    keys, groups = run_groups.group_runs(tests)
    pairs = build_pair_table("", keys, groups, [("a", "b")], ["lpips"])
    assert pairs.rows[0][1].mean == 1.0 and said in pairs.note
    with pytest.raises(ValueError, match=r"must have clips of the same seeds, got \[1\] and \[0\]"):
        build_difference_table("", ours[1:], theirs[:1], PAPER)


def test_what_was_not_tested_alike_is_named(tmp_path):
    ours = found(tmp_path, "lf3x3", {"a": 2.0, "b": 5.0})
    other = [replace(run, settings=run.settings | {"turbulence.severity": "weak"}) for run in ours]
    table = build_difference_table("", ours, other, PAPER)
    assert table.note.endswith("Test conditions differ: turbulence.severity.")
    assert "differ" not in build_difference_table("", ours, ours, PAPER).note


def test_settings_and_code_of_both_sides_are_named(tmp_path):
    def write(ckpt: str, warmup: float) -> runs.Run:
        settings = {"ckpt": ckpt, "backward_warmup_s": warmup}
        asked = {"overrides": (f"ckpt={ckpt}",), "settings": settings, "git": ckpt, "task": "eval"}
        write_run(tmp_path / ckpt, clips=[SCORES | {"name": "a"}], **asked)
        return runs.find_runs([tmp_path / ckpt])[0]

    ours, theirs = write("net", 0.3), write("old", 0.0)
    note = build_difference_table("", [ours], [theirs], PAPER).note
    assert "Settings: ckpt net against old." in note and "The code differs: net, old." in note
    other = replace(theirs, settings=theirs.settings | {"ckpt": "net"})
    note = build_difference_table("", [ours], [other], PAPER).note
    assert "Settings: backward_warmup_s 0.3 against 0." in note
    assert "Settings" not in build_difference_table("", [ours], [ours], PAPER).note


def test_columns_are_those_of_the_differences_from_against_too(tmp_path):
    for name in ("a", "b"):
        found(tmp_path, name, {"c": 0.3, "d": 0.4})
    given = [f"run={tmp_path}/a", f"against={tmp_path}/b", "columns=[lpips]"]
    report(config("report", tmp_path / "out", *given))
    text = (tmp_path / "out" / "report.md").read_text()
    assert "| LPIPS | 0.3500 | 0.3500 |" in text and "SSIM" not in text


def test_arguments_of_an_own_metric_of_both_sides_are_test_conditions(tmp_path):
    (one,) = found(tmp_path, "a", {"c": 2.0})
    record = one.record | {"own_metrics": {"blur": 1}}
    given = [one.settings | {"metrics.blur.size": size} for size in (1, 2)]
    sides = [replace(one, record=record, settings=settings) for settings in given]
    note = build_difference_table("", sides[:1], sides[1:], PAPER).note
    assert "Test conditions differ: metrics.blur.size." in note
    assert "conditions" not in build_difference_table("", sides[:1], [one], PAPER).note


def test_differences_need_the_same_clips(tmp_path):
    with pytest.raises(ValueError, match="run and against must hold the same clips"):
        build_difference_table(
            "", found(tmp_path, "a", {"a": 1.0}), found(tmp_path, "b", {"b": 1.0}), PAPER
        )


def sweep(folder) -> list[runs.Run]:
    """Runs of two methods, each in two severities, on two clips."""
    lpips = {"lf3x3": (0.30, 0.42), "one": (0.35, 0.40)}
    for method, values in lpips.items():
        for severity, more in (("weak", 0.0), ("strong", 0.1)):
            clips = [SCORES | {"name": f"c{n}", "lpips": v + more} for n, v in enumerate(values)]
            choices = {"method": method, "turbulence": severity, "experiment": "x"}
            asked = {
                "choices": choices,
                "overrides": (f"method={method}", f"turbulence={severity}"),
            }
            write_run(folder / method / severity, "x", clips=clips, task="eval", **asked)
    return runs.find_runs([folder])


def test_pairs_of_a_sweep_are_subtracted_clip_by_clip(tmp_path):
    keys, groups = run_groups.group_runs(sweep(tmp_path))
    assert keys == ("method", "turbulence")
    table = build_pair_table("Pairs", keys, groups, [("lf3x3", "one")], ["lpips", "ssim"])
    assert {row[0].text for row in table.rows} == {"weak", "strong"}
    assert {row[1].text for row in table.rows} == {"lf3x3 − one"}
    assert table.rows[0][2].mean == pytest.approx(-0.015)
    assert table.rows[0][2].interval == pytest.approx((-0.05, 0.02))
    text = format_markdown([table])
    assert "| -0.015 (-0.050 to +0.020) | +0.000 (+0.000 to +0.000) |" in text
    assert "2 test clips; mean (95 % bootstrap CI)" in text
    heads, first, *_ = format_csv_tables([table]).splitlines()
    assert heads == "table,turbulence,difference,lpips,lpips_low,lpips_high,ssim,ssim_low,ssim_high"
    assert first.startswith("Pairs,")


def test_intervals_over_few_scenes_say_how_often_they_hold_the_mean(tmp_path):
    few, many = (dict.fromkeys(map(str, range(count)), 0.3) for count in (12, 20))
    sides = [found(tmp_path, name, few) for name in ("a", "b")]
    said = " Of {} photographs or scenes such a CI holds one seed's mean in "
    note = build_difference_table("", *sides, PAPER).note
    assert said.format(12) + "about 91 % of cases." in note
    keys, groups = run_groups.group_runs([run for side in sides for run in side])
    assert build_pair_table("", keys, groups, [("a", "b")]).note.count(said.format(12)) == 1
    for number, clip in enumerate(sides[0][0].clips):
        clip["source"] = str(number // 4)
    note = build_difference_table("", *sides, PAPER).note
    assert said.format(3) + "about 75 % of cases." in note
    larger = [found(tmp_path, name, many) for name in ("c", "d")]
    assert "scenes" not in build_difference_table("", *larger, PAPER).note


def test_a_pair_with_a_run_missing_is_a_row_that_says_so(tmp_path):
    sweep(tmp_path)
    shutil.rmtree(tmp_path / "one" / "strong")
    keys, groups = run_groups.group_runs(runs.find_runs([tmp_path]))
    table = build_pair_table("Pairs", keys, groups, [("lf3x3", "one")], ["lpips"])
    text = format_markdown([table])
    assert "| strong | lf3x3 − one | missing |" in text
    assert "| weak | lf3x3 − one | -0.015 (-0.050 to +0.020) |" in text


def test_jobs_of_a_stopped_sweep_do_not_stand_for_those_that_ended(tmp_path):
    sweep(tmp_path)
    shutil.rmtree(tmp_path / "lf3x3" / "strong")
    shutil.rmtree(tmp_path / "one" / "strong")
    given = {"experiment": "x", "seed": "0", "method": "lf3x3,one", "turbulence": "weak,strong"}
    write_sweep(tmp_path, given)
    plans = runs.find_sweeps([tmp_path])
    keys, groups = run_groups.group_runs(runs.find_runs([tmp_path]), plans)
    text = format_markdown([build_pair_table("", keys, groups, [("lf3x3", "one")], ["lpips"])])
    assert "| weak | lf3x3 − one | -0.015 (-0.050 to +0.020) |" in text
    assert "| strong | lf3x3 − one | missing |" in text


@pytest.mark.parametrize("missing_last", [False, True])
def test_a_group_without_runs_never_replaces_one_with_runs(missing_last, tmp_path):
    keys, groups = run_groups.group_runs(sweep(tmp_path))
    missing = [run_groups.RunGroup(group.label, [], missing=1) for group in groups]
    both = [*groups, *missing] if missing_last else [*missing, *groups]
    table = build_pair_table("", keys, both, [("lf3x3", "one")], ["lpips"])
    assert "missing" not in format_markdown([table])


def test_older_runs_that_pairs_leave_out_are_in_the_note(tmp_path):
    found = sweep(tmp_path)
    tests = [replace(run, folder=run.folder / "again") for run in found[:1]]
    keys, groups = run_groups.group_runs([*found, *tests])
    both = [("lf3x3", "one"), ("one", "lf3x3")]
    note = build_pair_table("", keys, groups, both, ["lpips"]).note
    assert "1 older runs of the same seeds are left out." in note


def test_pairs_without_results_of_both_are_refused_and_the_page_stays(tmp_path):
    sweep(tmp_path / "runs")
    shutil.rmtree(tmp_path / "runs" / "one" / "strong")
    shutil.rmtree(tmp_path / "runs" / "lf3x3" / "weak")
    notes = tmp_path / "notes.md"
    notes.write_text("<!-- report:severity -->\nformer\n<!-- end:severity -->\n")
    given = [f"run={tmp_path}/runs", "pairs=[[lf3x3,one]]", "columns=lpips", "title=severity"]
    with pytest.raises(ValueError, match="pairs must have results of both .*none of lf3x3 and one"):
        report(config("report", tmp_path / "out", *given, f"into={notes}"))
    assert "former" in notes.read_text() and not (tmp_path / "out").exists()


def test_what_goes_with_a_pair_is_in_its_row(tmp_path):
    for ckpt, optics in (("setnet_small", "lf3x3"), ("single256", "single")):
        asked = {"choices": {"optics": optics}, "settings": {"ckpt": ckpt}, "task": "eval"}
        clips = [SCORES | {"name": "a"}]
        overrides = (f"ckpt={ckpt}", f"optics={optics}")
        write_run(tmp_path / ckpt, "eval", overrides=overrides, clips=clips, **asked)
    keys, groups = run_groups.group_runs(runs.find_runs([tmp_path]))
    assert keys == ("optics", "ckpt")
    table = build_pair_table("", keys, groups, [("setnet_small", "single256")], ["lpips"])
    labels = [cell.text for cell in table.rows[0][:2]]
    assert labels == ["lf3x3 − single", "setnet_small − single256"]


def test_a_difference_that_is_no_number_is_printed_so():
    assert format_cell(TableCell(math.nan, interval=(math.nan, math.nan)), METRICS[0]) == "nan"


def test_a_difference_whose_interval_excludes_zero_is_bold(tmp_path):
    keys, groups = run_groups.group_runs(sweep(tmp_path))
    table = build_pair_table("Pairs", keys, groups, [("weak", "strong")], ["lpips"])
    assert "| lf3x3 | weak − strong | **-0.100 (-0.100 to -0.100)** |" in format_markdown([table])


@pytest.mark.parametrize(
    ("pair", "columns", "message"),
    [
        (("lf3x3", "two"), None, "pairs must be two of the runs' settings"),
        (("lf3x3", "weak"), None, "pairs must be two of the runs' settings"),
        (("lf3x3", "one"), ["ssmi"], "columns must be of lpips, ssim"),
    ],
)
def test_a_pair_or_a_column_that_is_none_is_refused(tmp_path, pair, columns, message):
    keys, groups = run_groups.group_runs(sweep(tmp_path))
    with pytest.raises(ValueError, match=message):
        build_pair_table("", keys, groups, [pair], columns)


@pytest.mark.parametrize("clips", [[SCORES | {"name": "other"}], None])
def test_a_pair_of_runs_on_other_clips_or_without_any_is_refused(tmp_path, clips):
    found(tmp_path, "lf3x3", {"a": 0.3})
    write_run(tmp_path / "one", "one", clips=clips)
    keys, groups = run_groups.group_runs(runs.find_runs([tmp_path]))
    with pytest.raises(ValueError, match="pairs must hold the same clips, got 2 sets"):
        build_pair_table("", keys, groups, [("lf3x3", "one")])


def test_the_report_of_a_sweep_writes_its_pairs_into_a_document(tmp_path):
    sweep(tmp_path / "runs")
    notes = tmp_path / "notes.md"
    notes.write_text("<!-- report:severity -->\nformer\n<!-- end:severity -->\n")
    given = [f"run={tmp_path}/runs", "pairs=[[lf3x3,one]]", "columns=lpips", "title=severity"]
    report(config("report", tmp_path / "out", *given, f"into={notes}"))
    text = notes.read_text()
    assert "| weak | lf3x3 − one | -0.015 (-0.050 to +0.020) |" in text and "former" not in text
    assert "SSIM" not in text


@pytest.mark.parametrize("pairs", ["[lf3x3,one]", "lf3x3", "[[lf3x3]]"])
def test_pairs_that_are_none_are_refused(tmp_path, pairs):
    sweep(tmp_path / "runs")
    with pytest.raises(ValueError, match="pairs must be a list of pairs"):
        report(config("report", tmp_path / "out", f"run={tmp_path}/runs", f"pairs={pairs}"))


def test_one_clip_has_no_interval_and_is_not_bold(tmp_path):
    both = [*found(tmp_path, "one", {"a": 0.3}), *found(tmp_path, "two", {"a": 0.4})]
    keys, groups = run_groups.group_runs(both)
    table = build_pair_table("Pairs", keys, groups, [("one", "two")], ["lpips"])
    assert "| one − two | -0.100 |" in format_markdown([table])


def test_clips_without_a_score_are_left_out_and_photographs_are_resampled(tmp_path):
    ours = found(tmp_path, "one", dict.fromkeys("abcd", 0.3))
    theirs = found(tmp_path, "two", {"a": 0.1, "b": 0.2, "c": 0.4, "d": 0.5})
    for clip, source in zip(ours[0].clips, "xxyy", strict=True):
        clip["source"] = source
    pooled = pool_same_clips("run", ours, theirs)
    found_all = compare_clips(*pooled, "lpips")
    assert found_all.ours - found_all.theirs == pytest.approx(0) and found_all.scenes == 2
    assert found_all.interval == pytest.approx((-0.15, 0.15))
    del theirs[0].clips[0]["lpips"]
    left_out = compare_clips(*pooled, "lpips")
    assert left_out.ours - left_out.theirs == pytest.approx(0.3 - 1.1 / 3) and left_out.scenes == 2
    del theirs[0].clips[1]["lpips"]
    assert compare_clips(*pooled, "lpips").scenes == 1


def test_an_older_run_of_a_seed_is_no_further_seed(tmp_path):
    for name, lpips in (("old", 0.9), ("new", 0.3)):
        clips = [SCORES | {"name": "c0", "lpips": lpips}, SCORES | {"name": "c1", "lpips": lpips}]
        write_run(tmp_path / "runs" / name, clips=clips)
        os.utime(tmp_path / "runs" / name / "results.json", (0, 100 if name == "old" else 200))
    write_run(tmp_path / "peer", "one", clips=[c | {"lpips": 0.5} for c in clips])
    given = [f"run={tmp_path}/runs", f"against={tmp_path}/peer"]
    table = report(config("report", tmp_path / "out", *given))[-1]
    assert [cell.text for cell in table.rows[0][1:4]] == ["0.3000", "0.5000", "-0.2000"]
    assert "1 runs against 1" in table.note


def test_several_settings_have_no_one_difference(tmp_path):
    found(tmp_path, "lf3x3", {"a": 0.3, "b": 0.3})
    found(tmp_path, "one", {"a": 0.4, "b": 0.4})
    given = [f"run=[{tmp_path}/lf3x3,{tmp_path}/one]", f"against={tmp_path}/one"]
    with pytest.raises(
        ValueError, match="run must be runs of one setting with against.*lf3x3; one"
    ):
        report(config("report", tmp_path / "out", *given))
    assert not (tmp_path / "out").exists()


def test_sequences_count_by_their_frames_on_both_sides(tmp_path):
    for name, values in (("lf3x3", (0.2, 0.6)), ("one", (0.4, 0.4))):
        frames = zip(values, (30, 10), strict=True)
        clips = [
            SCORES | {"name": f"s{n}", "frames": f, "lpips": v} for v, f in frames for n in [f]
        ]
        write_run(tmp_path / name, name, clips=clips)
    ours, theirs = (runs.find_runs([tmp_path / name]) for name in ("lf3x3", "one"))
    row = build_difference_table("", ours, theirs, PAPER).rows[0]
    assert [cell.text for cell in row[:4]] == ["LPIPS", "0.3000", "0.4000", "-0.1000"]
