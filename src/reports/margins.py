"""By how much some runs beat others on the same clips, with the interval of the difference."""

from src.metrics.bootstrap import difference
from src.metrics.table import METRICS
from src.records.runs import Run
from src.reports.cells import matches
from src.reports.tables import Column, Table, Value

HEADS = ("ours", "theirs", "ours - theirs", "95 %", "the paper's")


def margins(title: str, ours: list[Run], theirs: list[Run], paper: dict) -> Table:
    """Return the means of `ours` and `theirs`, a run per seed, and their difference with the
    interval that holds 95 % of the differences when seeds and clips are resampled, clips in pairs.

    `paper`: as for `tables.main`; its difference stands where it has a row for both.  Raises
    ValueError where the clips of all runs are not the same.
    """
    names = {tuple(clip["name"] for clip in run.clips) for run in [*ours, *theirs]}
    if len(names) != 1 or not names.copy().pop():
        raise ValueError(f"run and against must hold the same clips, got {len(names)} sets of them")
    columns = [Column("metric", "metric"), *(Column(head, head) for head in HEADS)]
    table = Table(title, columns, [], 1)
    for metric in METRICS:
        if all(metric.name in clip for run in [*ours, *theirs] for clip in run.clips):
            sides = [[[float(clip[metric.name]) for clip in run.clips] for run in side]
                     for side in (ours, theirs)]  # fmt: skip
            published = [_published(side[0], metric.name, paper) for side in (ours, theirs)]
            words = _row(metric.digits + 1, *sides, published)
            table.rows.append([Value(words=word) for word in (metric.heading, *words)])
    table.note = f"{len(ours[0].clips)} clips; {len(ours)} runs against {len(theirs)}."
    return table


def _row(digits: int, ours: list, theirs: list, published: list[float | None]) -> list[str]:
    """Return the cells of a metric behind its heading."""
    left, right = (sum(map(sum, side)) / sum(map(len, side)) for side in (ours, theirs))
    low, high = difference(ours, theirs)
    said = "-" if None in published else f"{published[0] - published[1]:+.{digits}f}"
    interval = f"{low:+.{digits}f} to {high:+.{digits}f}"
    plain = [f"{value:.{digits}f}" for value in (left, right)]
    return [*plain, f"{left - right:+.{digits}f}", interval, said]


def _published(run: Run, name: str, paper: dict) -> float | None:
    fitting = [row for row in paper["rows"] if matches(run, row["when"])]
    return max(fitting, key=lambda row: len(row["when"]), default={}).get(name)
