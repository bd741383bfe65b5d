"""Scores that clips do not have, from the network to the record and back."""

import json
import math

import pytest

from src.records import results, runs
from src.reports.run_groups import group_runs
from src.reports.tables import build_severity_table
from tests.reports.runs import clips_of, write_run


def test_clips_without_a_score_are_left_out_of_the_mean_and_nan_is_not():
    clips = [{"ssim": 0.5, "psnr_aligned": value} for value in (20.0, None, 22.0)]
    found = results.summarize_scores(clips)
    assert found["clips"] == 3 and found["psnr_aligned"]["mean"] == 21
    assert found["psnr_aligned"] == results.summarize_scores(clips[::2])["psnr_aligned"]
    assert "psnr_aligned" not in results.summarize_scores(clips[1:2])
    assert math.isnan(
        results.summarize_scores([*clips, {"psnr_aligned": math.nan}])["psnr_aligned"]["mean"]
    )


def test_clips_of_one_photograph_are_no_independent_clips():
    rows = [{"source": name, "ssim": ssim} for name, ssim in [("a", 0.1), ("a", 0.2), ("b", 0.9)]]
    drawn = [row | {"source": ""} for row in rows]
    shared, apart = (results.summarize_scores(clips)["ssim"]["interval"] for clips in (rows, drawn))
    assert shared == pytest.approx((0.15, 0.9)) and apart[0] < 0.15
    for clips in (rows[:2], rows[:1]):
        found = json.dumps(results.summarize_scores(clips)["ssim"])
        assert json.loads(found)["interval"] is None and "NaN" not in found


def test_an_empty_cell_is_a_score_that_a_clip_does_not_have(tmp_path):
    clips = clips_of("weak weak medium")
    clips[0]["psnr_aligned"], clips[1]["psnr_aligned"] = None, 24.0
    write_run(tmp_path / "a", clips=clips)
    (run,) = runs.find_runs([tmp_path])
    assert "psnr_aligned" not in run.clips[0] and run.clips[1]["psnr_aligned"] == "24.0"
    keys, groups = group_runs([run])
    table = build_severity_table("by severity", keys, groups)
    place = [column.name for column in table.columns].index("psnr_aligned_weak")
    assert table.rows[0][place].mean == pytest.approx(24.0)
