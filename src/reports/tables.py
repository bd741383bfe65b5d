"""Tables of cells: scores and cost, severities apart, and what was scored on the same clips."""

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field

from src.metrics.table import METRICS
from src.records.runs import Run
from src.reports.cells import Cell, matches

SEVERITIES = ("none", "weak", "medium", "strong")


@dataclass(frozen=True)
class Column:
    """`better` is 1 where more is better, -1 where less is, 0 where neither; `group` stands above
    the columns that have it, such as the source of numbers that are not ours.
    """

    name: str
    head: str
    digits: int = 0
    better: int = 0
    group: str = ""


@dataclass(frozen=True)
class Value:
    """A mean over seeds with its sample standard deviation, None for one seed; or words."""

    mean: float | None = None
    spread: float | None = None
    words: str = ""


@dataclass
class Table:
    """Rows of values under columns; the first `labels` columns say what a row is.

    `marks` are the remarks [1], [2] ... of rows, `note` holds for all of them.
    """

    title: str
    columns: list[Column]
    rows: list[list[Value]]
    labels: int
    marks: list[str] = field(default_factory=list)
    note: str = ""

    def best(self, column: int) -> float | None:
        """Return the best mean of a column as it is printed; None where there is no best."""
        head = self.columns[column]
        means = [row[column].mean for row in self.rows if row[column].mean is not None]
        printed = {round(mean, head.digits) for mean in means}
        if head.better == 0 or len(printed) < 2:
            return None
        return max(printed) if head.better > 0 else min(printed)


SCORES = tuple(Column(m.name, m.heading, m.digits, m.better) for m in METRICS)
COSTS: tuple[tuple[Column, Callable[[Run], float]], ...] = (
    (Column("ms", "ms/frame", 1, -1), lambda run: next(iter(run.record["latency_ms"].values()))),
    (Column("gmac", "GMAC", 2), lambda run: run.record["model"]["macs_per_frame"] / 1e9),
    (Column("params", "params", 0), lambda run: run.record["model"]["params"]),
)
SPLIT = ("lpips", "psnr_aligned", "wobble")


def main(title: str, keys: tuple[str, ...], cells: list[Cell], paper: dict) -> Table:
    """Return scores, cost and number of seeds of each cell.

    `paper`: {source, rows: [{when: {key: value}, psnr ...}]}; its numbers stand in columns of their
    own where one of `cells` matches all of `when`.
    """
    shown = _with_paper(cells, paper)
    columns = [*map(_label, keys), *SCORES, *(column for column, _ in COSTS)]
    columns += [Column("n", "n"), *(column for column, _ in shown)]
    table = Table(title, columns, [], len(keys))
    for cell in cells:
        row = _names(cell, table.marks)
        row += [_over_seeds(cell.runs, _scored(column.name)) for column in SCORES]
        row += [_over_seeds(cell.runs, cost, column.better != 0) for column, cost in COSTS]
        row += [_count(cell), *(fill(cell) for _, fill in shown)]
        table.rows.append(row)
    table.note = _sizes(cells)
    return table


def by_severity(title: str, keys: tuple[str, ...], cells: list[Cell]) -> Table | None:
    """Return the scores of the clips of each severity; None where no cell has clips of several."""
    drawn = {clip["severity"] for cell in cells for run in cell.runs for clip in run.clips}
    several = any(len({c["severity"] for c in r.clips}) > 1 for cell in cells for r in cell.runs)
    present = [severity for severity in SEVERITIES if severity in drawn]
    if not several:
        return None
    split = [(score, severity) for score in SCORES if score.name in SPLIT for severity in present]
    heads = [
        Column(f"{score.name}_{severity}", severity, score.digits, score.better, score.head)
        for score, severity in split
    ]
    table = Table(title, [*map(_label, keys), *heads], [], len(keys))
    for cell in cells:
        row = [_over_seeds(cell.runs, _among(score.name, severity)) for score, severity in split]
        table.rows.append(_names(cell, table.marks) + row)
    return table


def compared(title: str, keys: tuple[str, ...], cells: list[Cell]) -> Table | None:
    """Return each network and what else its runs scored, such as the untrained one."""
    columns = [*map(_label, keys), Column("network", "network"), *SCORES]
    table = Table(title, columns, [], len(keys) + 1)
    for cell in cells:
        names = dict.fromkeys(name for run in cell.runs for name in run.record.get("compared", {}))
        words = _names(cell, table.marks) if names else []
        for name in (None, *names) if names else ():
            row = [_over_seeds(cell.runs, _scored(c.name, name)) for c in SCORES]
            table.rows.append([*words, Value(words=name or "trained"), *row])
    return table if table.rows else None


def _label(key: str) -> Column:
    return Column(key, key)


def _names(cell: Cell, marks: list[str]) -> list[Value]:
    """Return the words of the label; the first one carries the numbers of the cell's marks."""
    numbers = ", ".join(str(len(marks) + k) for k in range(1, len(cell.notes) + 1))
    marks += cell.notes
    first, *others = cell.label
    words = [f"{first} [{numbers}]" if numbers else first, *others]
    return [Value(words=word) for word in words]


def _count(cell: Cell) -> Value:
    done = len(cell.runs)
    if not cell.missing:
        return Value(words=str(done))
    return Value(words=f"{done} of {done + cell.missing}" if done else "missing")


def _over_seeds(
    runs: list[Run], measure: Callable[[Run], float | None], spreads: bool = True
) -> Value:
    values = [value for run in runs if (value := measure(run)) is not None and math.isfinite(value)]
    if not values:
        return Value()
    spread = statistics.stdev(values) if spreads and len(values) > 1 else None
    return Value(statistics.fmean(values), spread)


def _scored(metric: str, compared: str | None = None) -> Callable[[Run], float | None]:
    def measure(run: Run) -> float | None:
        test = run.record["compared"].get(compared, {}) if compared else run.record["test"]
        return test.get(metric, {}).get("mean")

    return measure


def _among(metric: str, severity: str) -> Callable[[Run], float | None]:
    def measure(run: Run) -> float | None:
        scores = [float(c[metric]) for c in run.clips if c["severity"] == severity and metric in c]
        return statistics.fmean(scores) if scores else None

    return measure


def _with_paper(cells: list[Cell], paper: dict) -> list[tuple[Column, Callable]]:
    """Return the columns of the paper's numbers for these cells, with what fills them."""

    def row(cell: Cell) -> dict:
        fitting = [r for r in paper["rows"] if cell.runs and matches(cell.runs[0], r["when"])]
        return max(fitting, key=lambda r: len(r["when"]), default={})

    def filled(metric: str) -> Callable[[Cell], Value]:
        return lambda cell: Value(row(cell).get(metric))

    if not any(map(row, cells)):
        return []
    return [
        (Column(f"paper_{c.name}", c.head, c.digits + (c.digits == 3), group=paper["source"]), fill)
        for c in SCORES
        if any((fill := filled(c.name))(cell).mean is not None for cell in cells)
    ]


def _sizes(cells: list[Cell]) -> str:
    """Say at what size the time and the operations of a frame were taken, and on what machine."""
    records = [run.record for cell in cells for run in cell.runs]
    if not records:
        return ""
    sizes = {size for record in records for size in record["latency_ms"]}
    clips = {record["test"]["clips"] for record in records}
    seeds = {frozenset(run.test_seed for run in cell.runs) for cell in cells if cell.runs}
    unlike = " Rows differ in the seed of their test clips." if len(seeds) > 1 else ""
    devices = {record["device"] for record in records}
    return (
        f"{_listed(clips)} test clips; ms and GMAC of one frame of {_listed(sizes)}; ± is the "
        f"sample standard deviation over n seeds; {_listed(devices)}.{unlike}"
    )


def _listed(values: set) -> str:
    return " or ".join(map(str, sorted(values)))
