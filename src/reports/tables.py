"""Tables of groups of runs: scores and cost, by severity, networks on the same clips."""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from src.metrics.table import METRICS, Column
from src.records.runs import Run
from src.reports.notes import describe_runs
from src.reports.run_groups import RunGroup, find_published

SEVERITIES = ("none", "weak", "medium", "strong", "extreme")
SPLIT_METRICS = ("lpips", "psnr_aligned", "temporal_jitter_px")  # of the table by severity


@dataclass(frozen=True)
class TableCell:
    """A mean over seeds with its sample standard deviation, None for one seed; or a text.

    `published`: a published value, which stands in parentheses.  `interval`: of a difference, its
    95 % CI.
    """

    mean: float | None = None
    std: float | None = None
    text: str = ""
    published: float | None = None
    interval: tuple[float, float] | None = None


@dataclass
class Table:
    """Rows of cells under columns; the first `labels` columns say what a row is."""

    title: str
    columns: list[Column]
    rows: list[list[TableCell]]
    labels: int
    note: str = ""
    groups: list[RunGroup] = field(default_factory=list)  # one per row

    def add_row(self, group: RunGroup, cells: Iterable[TableCell]) -> None:
        """Add a row of the group's label and `cells`."""
        self.rows.append([*(TableCell(text=text) for text in group.label), *cells])
        self.groups.append(group)

    def is_bold(self, number: int, place: int) -> bool:
        """Return whether a cell is the best of its column, or a difference whose CI excludes 0."""
        interval = self.rows[number][place].interval
        return self.is_best(number, place) if interval is None else interval[0] * interval[1] > 0

    def is_best(self, number: int, place: int) -> bool:
        """Return whether row `number` is the best in column `place`, as printed, of the rows with
        equal test conditions; of times, with equal frames and devices.
        """
        head, mean = self.columns[place], self.rows[number][place].mean
        if head.better == 0 or mean is None or math.isnan(mean):
            return False
        asked = self.groups[number].list_comparison_conditions(head.name)
        rows = zip(self.rows, self.groups, strict=True)
        means = [
            row[place].mean
            for row, group in rows
            if group.list_comparison_conditions(head.name) == asked
        ]
        numbers = [value for value in means if value is not None and not math.isnan(value)]
        printed = {round(value, head.digits) for value in numbers}
        best = (max if head.better > 0 else min)(printed)
        return len(printed) > 1 and round(mean, head.digits) == best


def list_metrics(runs: Iterable[Run]) -> tuple[Column, ...]:
    """Return the project's metrics and those that the configs of `runs` have added."""
    added = dict(item for run in runs for item in run.record.get("own_metrics", {}).items())
    return (*METRICS, *(Column(name, name, 3, better) for name, better in added.items()))


COSTS: tuple[tuple[Column, Callable[[Run], float]], ...] = (
    (Column("ms", "ms/frame", 1, -1), lambda run: next(iter(run.record["latency_ms"].values()))),
    (Column("gmac", "GMAC", 2), lambda run: run.record["model"]["macs_per_frame"] / 1e9),
    (Column("params", "params", 0), lambda run: run.record["model"]["params"]),
)


def build_score_table(
    title: str, keys: Sequence[str], groups: Sequence[RunGroup], published: Mapping[str, Any]
) -> Table:
    """Return scores, cost and number of seeds of each group.

    `published`: as for `find_published`, with its `source`; its numbers stand in columns of their
    own.
    """
    found = [find_published(group.runs[0], published) if group.runs else {} for group in groups]
    theirs = [score for score in METRICS if any(score.name in row for row in found)]
    metrics = list_metrics(run for group in groups for run in group.runs)
    columns = [*(Column(key, key) for key in keys), *metrics, *(column for column, _ in COSTS)]
    columns.append(Column("n", "n"))
    for c in theirs:
        digits = c.digits + (c.digits == 3)
        columns.append(Column(f"paper_{c.name}", c.heading, digits, group=published["source"]))
    table = Table(title, columns, [], len(keys))
    for group, row in zip(groups, found, strict=True):
        cells = [_mean_over_seeds(group.runs, _score(column.name)) for column in metrics]
        cells += [_mean_over_seeds(group.runs, cost, column.better != 0) for column, cost in COSTS]
        done, asked = len(group.runs), len(group.runs) + group.missing
        count = str(done) if not group.missing else f"{done} of {asked}" if done else "missing"
        published_cells = (TableCell(row.get(score.name)) for score in theirs)
        table.add_row(group, [*cells, TableCell(text=count), *published_cells])
    table.note = _describe_measurement(keys, groups) + _describe_gaps(groups, metrics)
    return table


def select_columns(table: Table, names: Sequence[str], title: str) -> Table:
    """Return the labels and the columns `names` of a score table, such as lpips, published values
    in parentheses, and n where it is not 1; rows with the same first labels stand together.

    Raises ValueError for a column that is not there.
    """
    places = {column.name: place for place, column in enumerate(table.columns)}
    scores = [
        name for name in places if places[name] >= table.labels and not name.startswith("paper_")
    ]
    check_columns(names, scores)
    if "n" not in names and any(len(g.runs) != 1 or g.missing for g in table.groups):
        names = [*names, "n"]
    chosen = [places[name] for name in names]
    heads = [*table.columns[: table.labels], *(table.columns[place] for place in chosen)]
    has_cost = any(column.name in names for column, _ in COSTS)
    keys = [column.name for column in table.columns[: table.labels]]
    note = _describe_measurement(keys, table.groups, has_cost)
    note += _describe_gaps(table.groups, [table.columns[place] for place in chosen])
    made = Table(title, heads, [], table.labels, note)
    by_key = zip(*(group.label for group in table.groups), strict=True)
    seen = [list(dict.fromkeys(labels)) for labels in by_key]
    rows = zip(table.groups, table.rows, strict=True)

    def turn(row: tuple[RunGroup, list[TableCell]]) -> list[int]:
        return [labels.index(own) for labels, own in zip(seen, row[0].label, strict=True)]

    for group, row in sorted(rows, key=turn):
        theirs = [row[places[key]].mean if (key := f"paper_{n}") in places else None for n in names]
        pairs = zip(chosen, theirs, strict=True)
        cells = [replace(row[place], published=value) for place, value in pairs]
        made.add_row(group, cells)
    return made


def check_columns(names: Sequence[str], present: Sequence[str]) -> None:
    """Raise ValueError for a name in `columns` that is none of those `present`."""
    for name in names:
        if name not in present:
            raise ValueError(f"columns must be of {', '.join(present)}, got {name}")


def build_severity_table(
    title: str, keys: Sequence[str], groups: Sequence[RunGroup]
) -> Table | None:
    """Return the scores of the clips of each severity; None where no run has clips of several."""
    drawn = [{clip.get("severity") for clip in run.clips} for group in groups for run in group.runs]
    if all(len(severities) < 2 for severities in drawn):
        return None
    present = [severity for severity in SEVERITIES if severity in set().union(*drawn)]
    split = [(s, severity) for s in METRICS if s.name in SPLIT_METRICS for severity in present]
    heads = [Column(f"{s.name}_{name}", name, s.digits, s.better, s.heading) for s, name in split]
    table = Table(title, [*(Column(key, key) for key in keys), *heads], [], len(keys))
    for group in groups:
        cells = []
        for score in (_score(s.name, severity=severity) for s, severity in split):
            drawn_by = [run for run in group.runs if score(run) is not None]
            cells.append(_mean_over_seeds(drawn_by, score))
        table.add_row(group, cells)
    return table


def build_reference_methods_table(
    title: str, keys: Sequence[str], groups: Sequence[RunGroup]
) -> Table | None:
    """Return each network and what else its runs scored, such as the untrained one."""
    metrics = list_metrics(run for group in groups for run in group.runs)
    columns = [*(Column(key, key) for key in keys), Column("network", "network"), *metrics]
    table = Table(title, columns, [], len(keys) + 1)
    for group in groups:
        others = dict.fromkeys(n for run in group.runs for n in run.record.get("compared", {}))
        for name in (None, *others) if others else ():
            cells = [_mean_over_seeds(group.runs, _score(c.name, name)) for c in metrics]
            table.add_row(group, [TableCell(text=name or "trained"), *cells])
    return table if table.rows else None


def _mean_over_seeds(
    runs: Sequence[Run], measure: Callable[[Run], float | None], with_std: bool = True
) -> TableCell:
    values = [value for run in runs if (value := measure(run)) is not None]
    if not values or len(values) < len(runs):  # not measured in all
        return TableCell()
    if not all(map(math.isfinite, values)):  # a run that diverged
        return TableCell(sum(values) / len(values))
    std = statistics.stdev(values) if with_std and len(values) > 1 else None
    return TableCell(statistics.fmean(values), std)


def _score(
    metric: str, compared: str | None = None, severity: str | None = None
) -> Callable[[Run], float | None]:
    """Return what reads the mean of a run: of the network `compared`, or of clips of `severity`."""

    def measure(run: Run) -> float | None:
        if severity is None:
            test = run.record["compared"].get(compared, {}) if compared else run.record["test"]
            return test.get(metric, {}).get("mean")
        clips = [clip for clip in run.clips if clip.get("severity") == severity and metric in clip]
        return statistics.fmean(float(clip[metric]) for clip in clips) if clips else None

    return measure


def _describe_gaps(groups: Sequence[RunGroup], columns: Iterable[Column]) -> str:
    """Say which scores some of the runs of a group lack."""
    gaps = []
    for column in columns:
        measured = [[_score(column.name)(run) is not None for run in g.runs] for g in groups]
        gaps += [column.heading] if any(any(row) and not all(row) for row in measured) else []
    return f" Left out where one of the n runs lacks it: {', '.join(gaps)}." if gaps else ""


def _describe_measurement(
    keys: Sequence[str], groups: Sequence[RunGroup], with_cost: bool = True
) -> str:
    """Say how many clips there were and, `with_cost`, at what size and where a frame was timed; and
    what `describe_runs` says."""
    runs = [run for group in groups for run in group.runs]
    if not runs:
        return ""
    found = (
        {run.record["test"]["clips"] for run in runs},
        {size for run in runs for size in run.record["latency_ms"]},
        {run.record["device"] for run in runs},
    )
    clips, sizes, devices = (" or ".join(map(str, sorted(values))) for values in found)
    seeds = {frozenset(run.test_seed for run in group.runs) for group in groups if group.runs}
    unlike = " Rows differ in the seed of their test clips." if len(seeds) > 1 else ""
    if len({group.test_conditions for group in groups if group.runs}) > 1:
        unlike += " Bold: the best of the rows with equal scene, turbulence, sensor and clips."
    cost = f"; ms and GMAC of one frame of {sizes}, {devices}" if with_cost else ""
    spread = "; ± is the sample standard deviation over n seeds"
    several = with_cost or any(len(group.runs) > 1 for group in groups)
    return (
        f"{clips} test clips{cost}{spread if several else ''}.{unlike}{describe_runs(keys, groups)}"
    )
