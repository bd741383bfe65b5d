"""What runs are ahead of others by, clip by clip."""

import pytest

from src.records import runs
from src.reports.tables import build_difference_table
from tests.reports.runs import SCORES, write_run

PAPER = {"source": "paper", "rows": [
    {"when": {"experiment": "lf3x3"}, "lpips": 0.43}, {"when": {"experiment": "one"}, "lpips": 0.46}
]}  # fmt: skip


def found(folder, experiment: str, *clips: dict[str, float]) -> list[runs.Run]:
    for seed, values in enumerate(clips):
        rows = [SCORES | {"name": name, "lpips": value} for name, value in values.items()]
        write_run(folder / experiment / str(seed), experiment, seed, clips=rows)
    return runs.find_runs([folder / experiment])


def test_differences_are_ours_minus_theirs_with_an_interval(tmp_path):
    ours = found(tmp_path, "lf3x3", {"a": 2.0, "b": 5.0}, {"a": 2.0, "b": 5.0})
    theirs = found(tmp_path, "one", {"a": 1.0, "b": 4.0})
    table = build_difference_table("Clip by clip", ours, theirs, PAPER)
    assert [value.text for value in table.rows[0]] == [
        "LPIPS", "3.5000", "2.5000", "+1.0000", "+1.0000 to +1.0000", "-0.0300"
    ]  # fmt: skip
    assert table.rows[1][-1].text == "-"


def test_differences_need_the_same_clips(tmp_path):
    with pytest.raises(ValueError, match="run and against must hold the same clips"):
        build_difference_table(
            "", found(tmp_path, "a", {"a": 1.0}), found(tmp_path, "b", {"b": 1.0}), PAPER
        )
