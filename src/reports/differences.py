"""Tables of differences on the same clips: of two sets of runs, and of pairs of a sweep's runs."""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from src.metrics.bootstrap import bootstrap_difference_interval
from src.metrics.table import Column
from src.records.runs import Run
from src.reports.run_groups import RunGroup, find_published
from src.reports.tables import Table, TableCell, list_metrics


def build_difference_table(
    title: str, ours: Sequence[Run], theirs: Sequence[Run], published: Mapping[str, Any]
) -> Table:
    """Return the means of `ours` and `theirs`, a run per seed, and their difference with the 95 %
    bootstrap CI (seeds and clips resampled, clips in pairs); beside it the published difference.

    Raises ValueError where the clips of all runs are not the same.
    """
    names = {tuple(clip["name"] for clip in run.clips) for run in [*ours, *theirs]}
    if len(names) != 1 or () in names:
        raise ValueError(f"run and against must hold the same clips, got {len(names)} sets of them")
    heads = ("metric", "ours", "theirs", "ours - theirs", "95 % bootstrap CI", "published")
    table = Table(title, [Column(head, head) for head in heads], [], 1)
    rows = [find_published(side[0], published) for side in (ours, theirs)]
    for metric in list_metrics([*ours, *theirs]):
        if not all(metric.name in clip for run in [*ours, *theirs] for clip in run.clips):
            continue
        sides = [[[float(clip[metric.name]) for clip in run.clips] for run in side]
                 for side in (ours, theirs)]  # fmt: skip
        left, right = (sum(map(sum, side)) / sum(map(len, side)) for side in sides)
        low, high = bootstrap_difference_interval(sides[0], sides[1])
        first, second = (row.get(metric.name) for row in rows)
        digits = metric.digits + 1
        texts = [metric.heading, *(f"{value:.{digits}f}" for value in (left, right))]
        texts += [f"{left - right:+.{digits}f}", f"{low:+.{digits}f} to {high:+.{digits}f}"]
        change = None if first is None or second is None else first - second
        texts.append("-" if change is None else f"{change:+.{digits}f}")
        table.rows.append([TableCell(text=text) for text in texts])
    table.note = f"{len(ours[0].clips)} clips; {len(ours)} runs against {len(theirs)}."
    return table


def build_pair_table(
    title: str,
    keys: Sequence[str],
    groups: Sequence[RunGroup],
    pairs: Sequence[tuple[str, str]],
    names: Sequence[str] | None = None,
) -> Table:
    """Return A - B, with the 95 % bootstrap CI, for each of `pairs` = (A, B) of labels, such as two
    methods, in a row for every value of the other settings.  `names`: of the metrics, None: all.

    Raises ValueError for a metric or a pair that is none, and where the clips of a pair differ.
    """
    metrics = _choose_metrics(groups, names)
    places = [_find_key_of_pair(groups, pair) for pair in pairs]
    place = places[0]
    if len(set(places)) > 1:
        raise ValueError(f"pairs must be of one setting, got {', '.join(keys[k] for k in places)}")
    finished = {group.label: group.runs for group in groups if group.runs}
    rest = dict.fromkeys((*label[:place], *label[place + 1 :]) for label in finished)
    columns = [*(Column(key, key) for key in keys), *metrics]
    columns[place : place + 1] = []
    columns.insert(len(keys) - 1, Column("difference", "difference"))
    table, clips = Table(title, columns, [], len(keys)), set()
    for others in rest:
        for pair in pairs:
            sides = [finished.get((*others[:place], name, *others[place:])) for name in pair]
            if sides[0] is None or sides[1] is None:
                continue
            texts = [*others, " − ".join(pair)]
            cells = [_subtract(sides[0], sides[1], metric.name) for metric in metrics]
            table.rows.append([*(TableCell(text=text) for text in texts), *cells])
            clips.add(len(sides[0][0].clips))
    counts = " or ".join(map(str, sorted(clips)))
    table.note = f"{counts} test clips; mean (95 % bootstrap CI); bold: the CI excludes zero."
    return table


def _choose_metrics(groups: Sequence[RunGroup], names: Sequence[str] | None) -> list[Column]:
    present = list_metrics(run for group in groups for run in group.runs)
    for name in names or ():
        if name not in [metric.name for metric in present]:
            listed = ", ".join(metric.name for metric in present)
            raise ValueError(f"columns must be of {listed}, got {name}")
    return [metric for metric in present if names is None or metric.name in names]


def _find_key_of_pair(groups: Sequence[RunGroup], pair: tuple[str, str]) -> int:
    """Return which of the labels takes both values of `pair`."""
    by_key = [set(labels) for labels in zip(*(group.label for group in groups), strict=True)]
    for place, labels in enumerate(by_key):
        if labels >= set(pair):
            return place
    listed = "; ".join(", ".join(sorted(labels)) for labels in by_key)
    raise ValueError(f"pairs must be two of the runs' settings ({listed}), got {list(pair)}")


def _subtract(ours: Sequence[Run], theirs: Sequence[Run], metric: str) -> TableCell:
    """Return the mean difference of a metric; empty where a clip has none."""
    clips = {tuple(clip["name"] for clip in run.clips) for run in [*ours, *theirs]}
    if len(clips) != 1:
        raise ValueError(f"pairs must have been tested on the same clips, got {len(clips)} sets")
    if not all(metric in clip for run in [*ours, *theirs] for clip in run.clips):
        return TableCell()
    sides = [[[float(clip[metric]) for clip in run.clips] for run in side]
             for side in (ours, theirs)]  # fmt: skip
    left, right = (fmean(value for run in side for value in run) for side in sides)
    return TableCell(left - right, interval=bootstrap_difference_interval(sides[0], sides[1]))
