"""Numbers, marks and gaps as they reach the tables, the documents and the page."""

import csv
import io
import json
import math

import pytest
from omegaconf import OmegaConf

from src.records import runs
from src.report import report
from src.reports import run_groups, tables, writers
from tests.conftest import ROOT
from tests.reports.runs import clips_of, write_run, write_sweep
from tests.test_entry_points import run_here
from tests.test_train import config

NO_PAPER = {"source": "none", "rows": []}
PAPER = {"source": "paper: other data", "rows": [{"when": {"experiment": "lf3x3"}, "psnr": 15.4}]}


def built(folder, paper=NO_PAPER):
    keys, made = run_groups.group_runs(runs.find_runs([folder]), runs.find_sweeps([folder]))
    return tables.build_score_table("main", keys, made, paper), keys, made


def value(table, row, name):
    place = [column.name for column in table.columns].index(name)
    return table.rows[row][place]


def test_mean_and_sample_deviation_over_seeds(tmp_path):
    for seed, ssim in enumerate((0.5, 0.6, 0.7)):
        write_run(tmp_path / str(seed), seed=seed, scores={"ssim": ssim})
    table, _, _ = built(tmp_path)
    found = value(table, 0, "ssim")
    assert math.isclose(found.mean, 0.6) and math.isclose(found.std, 0.1)
    assert value(table, 0, "gmac") == tables.TableCell(0.608) and value(table, 0, "n").text == "3"
    assert writers.format_cell(found, tables.METRICS[1]) == "0.600 ± 0.100"


def test_one_seed_has_no_spread(tmp_path):
    write_run(tmp_path / "a")
    assert value(built(tmp_path)[0], 0, "ssim").std is None


def test_a_metric_not_taken_is_a_dash_and_one_that_is_no_number_is_not(tmp_path):
    write_run(tmp_path / "a", "a", scores={"lpips": math.nan})
    write_run(tmp_path / "b", "b", without=("lpips",))
    table, _, _ = built(tmp_path)
    shown = [writers.format_cell(value(table, k, "lpips"), tables.METRICS[0]) for k in (0, 1)]
    assert shown == ["nan", "-"]
    assert not table.is_best(0, table.columns.index(tables.METRICS[0]))


def test_a_metric_that_one_seed_lacks_has_no_mean_of_the_others(tmp_path):
    for seed in (0, 1):
        write_run(tmp_path / str(seed), seed=seed, without=("lpips",) * seed)
    table, _, _ = built(tmp_path)
    assert value(table, 0, "lpips").mean is None and value(table, 0, "n").text == "2"
    assert "Left out where one of the n runs lacks it: LPIPS." in table.note
    assert "lacks it: LPIPS." in tables.select_columns(table, ["lpips"], "main").note
    assert "lacks it" not in tables.select_columns(table, ["ssim"], "main").note


def test_a_seed_that_diverged_is_not_left_out(tmp_path):
    for seed, psnr in enumerate((20.0, 22.0, math.nan)):
        write_run(tmp_path / str(seed), seed=seed, scores={"psnr": psnr})
    table, _, _ = built(tmp_path)
    assert math.isnan(value(table, 0, "psnr").mean) and value(table, 0, "ssim").mean == 0.6


def test_chosen_columns_have_the_number_of_seeds_where_it_is_not_one(tmp_path):
    write_sweep(tmp_path, {"experiment": "lf3x3,single256", "seed": "range(2)"})
    for seed in (0, 1):
        write_run(tmp_path / str(seed), "lf3x3", seed, scores={"ssim": 0.5 + 0.1 * seed})
    text = writers.format_markdown([tables.select_columns(built(tmp_path)[0], ["ssim"], "main")])
    assert "| lf3x3 | 0.550 ± 0.071 | 2 |" in text and "| single256 | - | missing |" in text


def test_runs_of_other_code_are_named(tmp_path):
    for name in ("a", "b"):
        write_run(tmp_path / name, name, git=name)
    table, _, _ = built(tmp_path)
    for shown in (table, tables.select_columns(table, ["ssim"], "main")):
        assert shown.note.endswith(" The code differs: a, b.")
    assert "code" not in built(tmp_path / "a")[0].note


def test_arguments_of_an_own_metric_part_its_best_values_only(tmp_path):
    for name, size in (("a", 1), ("b", 2)):
        settings = {"metrics": {"blur": {"size": size}}}
        scores = {"blur": size / 10, "ssim": size / 10}
        write_run(tmp_path / name, name, settings=settings, scores=scores, own={"blur": 1})
    table, _, _ = built(tmp_path)
    names = [column.name for column in table.columns]
    best = {k: [table.is_best(row, names.index(k)) for row in (0, 1)] for k in ("ssim", "blur")}
    assert best == {"ssim": [False, True], "blur": [False, False]}


def test_other_ranges_of_sequences_are_other_conditions(tmp_path):
    for name, end in (("a", 1.0), ("b", 2.0)):
        settings = {"data": {"sequences": {"ECD": {"slider_depth": [0.0, end]}}}}
        write_run(tmp_path / name, name, settings=settings, scores={"ssim": end / 10})
    table, _, _ = built(tmp_path)
    assert not any(table.is_best(row, table.columns.index(tables.METRICS[1])) for row in (0, 1))


def test_missing_cells_are_shown(tmp_path):
    write_sweep(tmp_path, {"experiment": "lf3x3,single256", "seed": "range(2)"})
    write_run(tmp_path / "a", "lf3x3", 0)
    table, _, _ = built(tmp_path)
    assert [value(table, row, "n").text for row in (0, 1)] == ["1 of 2", "missing"]
    assert value(table, 1, "psnr").mean is None
    assert "differ in the seed" not in table.note


def test_rows_of_other_seeds_saw_other_clips_and_it_is_said(tmp_path):
    write_run(tmp_path / "a", "lf3x3", 0)
    write_run(tmp_path / "b", "single256", 1)
    assert "differ in the seed" in built(tmp_path)[0].note


def test_trainings_of_other_seeds_saw_the_same_clips(tmp_path):
    for seed, name in enumerate(("lf3x3", "single256")):
        write_run(tmp_path / name, name, seed, settings={"data": {"test_seed": 0}})
    assert "differ in the seed" not in built(tmp_path)[0].note


def test_severities_are_means_over_their_clips(tmp_path):
    write_run(tmp_path / "a", seed=0, clips=clips_of("strong weak weak", lpips=0.3))
    _, keys, made = built(tmp_path)
    table = tables.build_severity_table("split", keys, made)
    assert math.isclose(value(table, 0, "lpips_weak").mean, 0.45)
    assert math.isclose(value(table, 0, "lpips_strong").mean, 0.3)
    assert "lpips_medium" not in [column.name for column in table.columns]


def test_one_severity_needs_no_split(tmp_path):
    write_run(tmp_path / "a", clips=clips_of("weak weak"))
    _, keys, made = built(tmp_path)
    assert tables.build_severity_table("split", keys, made) is None


def test_the_papers_numbers_stand_in_columns_of_their_own(tmp_path):
    write_run(tmp_path / "a", "lf3x3")
    write_run(tmp_path / "b", "single256")
    table, _, _ = built(tmp_path, PAPER)
    assert value(table, 0, "paper_psnr").mean == 15.4 and value(table, 0, "psnr").mean == 17.0
    assert value(table, 1, "paper_psnr").mean is None
    assert "paper: other data: PSNR" in writers.format_markdown([table])
    assert "paper_ssim" not in [column.name for column in table.columns]


def test_chosen_columns_have_the_papers_numbers_in_parentheses_and_equal_labels_together(tmp_path):
    order = [("lf3x3", "none"), ("single256", "none"), ("lf3x3", "mambatm")]
    for number, (name, post) in enumerate(order):
        chosen = {"postprocess": post}
        settings = {"postprocess": None if post == "none" else {"frames": 4}}
        write_run(tmp_path / str(number), name, choices=chosen, settings=settings)
    table = tables.select_columns(built(tmp_path, PAPER)[0], ["psnr", "ssim"], "main")
    assert [tuple(cell.text for cell in row[:2]) for row in table.rows] == [
        ("lf3x3", "none"), ("lf3x3", "mambatm"), ("single256", "none")
    ]  # fmt: skip
    text = writers.format_markdown([table])
    assert "| lf3x3 | none | 17.00 (15.40) | 0.600 |" in text
    assert "| single256 | none | 17.00 |" in text
    assert table.note == "9 test clips."
    with pytest.raises(ValueError, match="columns must be of lpips, .*, got paper_psnr"):
        tables.select_columns(built(tmp_path, PAPER)[0], ["paper_psnr"], "main")


@pytest.mark.parametrize(
    ("published", "shown"),
    [(0.5215, "0.522"), (0.5185, "0.519"), (0.5214, "0.521"), (0.4, "0.400")],
)
def test_published_values_are_rounded_half_up(published, shown):
    cell = tables.TableCell(0.3, published=published)
    assert writers.format_cell(cell, tables.METRICS[0]) == f"0.300 ({shown})"


def test_what_else_was_scored_stands_below_its_network(tmp_path):
    write_run(tmp_path / "a", scores={"ssim": 0.7})
    write_run(tmp_path / "b", "eval", task="eval", scores={"ssim": 0.3}, compared={})
    _, keys, made = built(tmp_path)
    table = tables.build_reference_methods_table("compared", keys, made)
    assert [row[1].text for row in table.rows] == ["trained", "untrained"]
    assert [row[3].mean for row in table.rows] == [0.7, 0.1]


def test_the_best_of_a_column_is_what_is_printed_best(tmp_path):
    for name, psnr in [("a", 17.001), ("b", 17.0), ("c", 16.0)]:
        write_run(tmp_path / name, name, scores={"psnr": psnr})
    table, _, _ = built(tmp_path)
    place = [column.name for column in table.columns].index("psnr")
    assert [table.is_best(row, place) for row in range(3)] == [True, True, False]


def test_the_best_is_one_of_the_rows_with_equal_conditions(tmp_path):
    for strength, better in (("weak", 20.0), ("strong", 15.0)):
        for name in ("lf3x3", "single256"):
            asked = {"settings": {"turbulence": {"severity": strength}, "width": len(name)}}
            scores = {"psnr": better + (name == "lf3x3")}
            write_run(tmp_path / f"{strength}{name}", name, scores=scores, **asked)
    write_run(tmp_path / "alone", "alone", seed=7, scores={"psnr": 30.0}, task="eval")
    table, _, _ = built(tmp_path)
    best = [row for row in range(5) if table.is_best(row, table.columns.index(tables.METRICS[2]))]
    found = {(table.rows[row][0].text, table.rows[row][1].text) for row in best}
    assert sorted(value(table, row, "psnr").mean for row in best) == [16.0, 21.0]
    assert all("lf3x3" in names for names in found) and "Bold: the best of the rows" in table.note
    text = writers.format_markdown([table])
    assert "**21.00**" in text and "**16.00**" in text and "**30.00**" not in text


def test_times_are_compared_on_equal_frames_whatever_the_turbulence(tmp_path):
    for place, (size, ms) in enumerate([("128x128", 9.0), ("128x128", 5.0), ("64x64", 1.0)]):
        run = write_run(tmp_path / str(place), f"net{place}", settings={"fps": 100 + place})
        record = json.loads((run / "results.json").read_text()) | {"latency_ms": {size: ms}}
        (run / "results.json").write_text(json.dumps(record))
    table, _, _ = built(tmp_path)
    place = [column.name for column in table.columns].index("ms")
    best = [table.rows[row][place].mean for row in range(3) if table.is_best(row, place)]
    assert best == [5.0]


def test_csv_has_full_precision_and_mean_and_spread_apart(tmp_path):
    for seed, ssim in enumerate((0.123456789, 0.2)):
        write_run(tmp_path / str(seed), seed=seed, scores={"ssim": ssim})
    (row,) = csv.DictReader(io.StringIO(writers.format_csv_tables([built(tmp_path)[0]])))
    assert float(row["ssim"]) == (0.123456789 + 0.2) / 2 and float(row["ssim_std"]) > 0
    assert row["experiment"] == "lf3x3"


def test_a_section_is_replaced_and_the_text_around_it_stays(tmp_path):
    document = tmp_path / "results.md"
    document.write_text("before\n<!-- report:a -->\nold\n<!-- end:a -->\nafter\n")
    writers.replace_section(document, "a", "new\n")
    writers.replace_section(document, "a", "newer\n")
    wanted = "before\n<!-- report:a -->\n\nnewer\n\n<!-- end:a -->\nafter\n"
    assert document.read_text() == wanted and list(tmp_path.iterdir()) == [document]
    writers.replace_section(document, "b", "more")
    assert document.read_text() == (
        wanted + "\n## b\n\n<!-- report:b -->\n\nmore\n\n<!-- end:b -->\n"
    )


@pytest.mark.parametrize(
    "content",
    [
        "<!-- report:a -->\nno end",
        "<!-- end:a -->\n<!-- report:a -->",
        "<!-- report:a --><!-- report:a --><!-- end:a -->",
    ],
)
def test_markers_that_are_no_pair_are_refused_and_the_document_stays(content, tmp_path):
    document = tmp_path / "results.md"
    document.write_text(content)
    with pytest.raises(ValueError, match="into must hold <!-- report:a -->"):
        writers.replace_section(document, "a", "new")
    assert document.read_text() == content
    with pytest.raises(ValueError, match="into must be a file"):
        writers.replace_section(tmp_path / "nowhere.md", "a", "new")


def test_every_row_of_the_paper_names_choices_that_exist():
    rows = OmegaConf.load(ROOT / "conf" / "paper" / "reds.yaml").rows
    folders = {"method": "sweeps", "resolution": "sweeps", "postprocess": "conf"}
    for row in rows:
        for group, choice in row.when.items():
            if group != "task":
                assert (ROOT / folders.get(group, "conf") / group / f"{choice}.yaml").is_file()
    assert len(rows) == len({str(row.when) for row in rows}) >= 3 + 19


def test_the_most_specific_row_of_the_paper_stands_beside_a_run(tmp_path):
    for place, post in enumerate(("none", "mambatm")):
        choices = {"method": "firenet_plus", "resolution": "native256", "postprocess": post}
        write_run(tmp_path / str(place), "firenet_plus", choices=choices, task="eval")
    paper = {
        "source": "paper",
        "rows": [
            {"when": {"method": "firenet_plus"}, "psnr": 1.0},
            {"when": {"method": "firenet_plus", "postprocess": "mambatm"}, "psnr": 2.0},
        ],
    }
    table, keys, _ = built(tmp_path, paper)
    assert keys == ("postprocess",)
    assert [value(table, row, "paper_psnr").mean for row in (0, 1)] == [1.0, 2.0]


def test_the_entry_point_writes_three_files_and_the_section(tmp_path):
    write_run(tmp_path / "runs" / "a", clips=clips_of())
    document = tmp_path / "results.md"
    document.write_text("<!-- report:table1 -->\n<!-- end:table1 -->\n")
    overrides = f"run={tmp_path / 'runs'}", f"into={document}"
    cfg = config("report", tmp_path / "out", *overrides)
    assert [table.title for table in report(cfg)] == [
        "Scores and cost",
        "Scores by severity",
        "On the same clips",
    ]
    written = {file.name for file in (tmp_path / "out").iterdir()}
    assert {"report.md", "report.csv", "report.html"} <= written
    assert "| lf3x3 | **" not in document.read_text() and "| lf3x3 |" in document.read_text()
    report(config("report", tmp_path / "out2", *overrides, "columns=lpips"))
    assert "LPIPS" in document.read_text() and "SSIM" not in document.read_text()
    assert "ssim" in (tmp_path / "out2" / "report.csv").read_text()


def test_each_sweep_has_tables_headed_by_its_own_settings(tmp_path):
    for lr in ("1", "2"):
        asked = {"overrides": (f"lr={lr}",), "settings": {"lr": float(lr)}}
        write_run(tmp_path / "runs" / f"a{lr}", config_name="rates", **asked)
    for width in ("8", "16"):
        asked = {"overrides": (f"width={width}",), "settings": {"width": int(width)}}
        write_run(tmp_path / "runs" / f"b{width}", config_name="widths", **asked)
    found = report(config("report", tmp_path / "out", f"run={tmp_path / 'runs'}"))
    heads = {t.title: [c.name for c in t.columns[: t.labels]] for t in found}
    assert heads["Scores and cost: rates"] == ["lr"]
    assert heads["Scores and cost: widths"] == ["width"]
    text = (tmp_path / "out" / "report.html").read_text()
    assert text.index("Scores and cost: rates") < text.index("Scores and cost: widths")


def test_of_several_sweeps_one_without_results_is_missing_too(tmp_path):
    write_run(tmp_path / "runs" / "a", config_name="rates")
    write_sweep(tmp_path / "runs" / "none", {"experiment": "lf3x3", "seed": "0,1"})
    found = {t.title: t for t in report(config("report", tmp_path / "out", f"run={tmp_path}/runs"))}
    missing = value(found["Scores and cost: table1"], 0, "n")
    assert missing.text == "missing"


def test_jobs_whose_paths_were_quoted_for_hydra_are_not_missing(tmp_path):
    quoted = ("ckpt='lf3x3','/a b/net.ckpt'", "scene.root='/data/photographs'")
    write_sweep(tmp_path / "runs", {"experiment": "lf3x3", "seed": "0"}, quoted)
    for place, ckpt in enumerate(("lf3x3", "/a b/net.ckpt")):
        asked = (f"ckpt={ckpt}", "scene.root=/data/photographs")
        settings = {"ckpt": ckpt}
        write_run(tmp_path / "runs" / str(place), overrides=asked, settings=settings, task="eval")
    table = report(config("report", tmp_path / "out", f"run={tmp_path}/runs"))[0]
    assert [value(table, row, "n").text for row in range(len(table.rows))] == ["1", "1"]
    text = (tmp_path / "out" / "report.md").read_text()
    assert "ckpt=lf3x3,'/a b/net.ckpt' scene.root=/data/photographs`" in text


def test_a_run_that_did_not_end_is_named(tmp_path, capsys):
    write_run(tmp_path / "runs" / "a")
    (write_run(tmp_path / "runs" / "b", "b") / "results.json").unlink()
    report(config("report", tmp_path / "out", f"run={tmp_path}/runs"))
    said = capsys.readouterr().out
    assert f"left out, without results.json: {tmp_path}/runs/b" in said


def test_an_empty_folder_is_refused_and_nothing_is_written(tmp_path):
    (tmp_path / "runs").mkdir()
    with pytest.raises(ValueError, match="run must hold results.json"):
        report(config("report", tmp_path / "out", f"run={tmp_path / 'runs'}"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("run=[]", "run must name one folder or more"),
        ("against=[]", "against must name one folder or more"),
        ("against=''", "against must name one folder or more"),
        ("columns=[]", "columns must name one score or more"),
        ("media_mib=-1", "media_mib must be >= 0, got -1"),
        ("across=[nope]", "across must be settings of the runs, such as ckpt, got nope"),
        ("into=nowhere.md", "into must be a file, got nowhere.md"),
    ],
)
def test_a_wrong_value_writes_nothing(wrong, message, tmp_path):
    write_run(tmp_path / "runs" / "a", clips=clips_of())
    with pytest.raises(ValueError, match=message):
        report(config("report", tmp_path / "out", f"run={tmp_path / 'runs'}", wrong))
    assert not (tmp_path / "out").exists()


def test_the_folder_of_a_run_takes_no_other_config(tmp_path):
    folder = write_run(tmp_path / "run", clips=clips_of())
    before = (folder / "config.yaml").read_text()
    with pytest.raises(ValueError, match=r"hydra\.run\.dir.*holds results of another config"):
        report(config("report", folder, f"run={folder}"))
    assert (folder / "config.yaml").read_text() == before


def test_a_test_that_ended_is_not_left_out_and_one_without_results_is(tmp_path):
    words = ["baseline=highpass", "debug=fdr", "metrics.lpips=null"]
    assert run_here("eval", *words, f"hydra.run.dir={tmp_path}/run") == 0
    assert (tmp_path / "run/.hydra/config.yaml").is_file()
    assert runs.find_unfinished_runs([tmp_path]) == []
    (tmp_path / "run/results.json").unlink()
    assert runs.find_unfinished_runs([tmp_path]) == [tmp_path / "run"]
