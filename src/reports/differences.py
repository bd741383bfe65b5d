"""Tables of differences on the same clips: of two sets of runs, and of pairs of a sweep's runs."""

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from src.metrics.bootstrap import bootstrap_difference_interval
from src.metrics.table import Column
from src.records.results import frame_weights
from src.records.runs import Run
from src.reports.run_groups import RunGroup, find_differing_test_conditions, find_published
from src.reports.tables import Table, TableCell, check_columns, list_metrics

ClipsOfRuns = list[list[dict[str, str]]]


def build_difference_table(
    title: str, ours: Sequence[Run], theirs: Sequence[Run], published: Mapping[str, Any]
) -> Table:
    """Return the means of `ours` and `theirs`, a run per seed, and their difference with the 95 %
    CI (`bootstrap_difference_interval`); beside it the published difference.  A note names the test
    conditions that differ.

    Raises ValueError where the clips of all runs are not the same.
    """
    left_clips, right_clips = _pool_same_clips("run and against", ours, theirs)
    heads = ("metric", "ours", "theirs", "ours - theirs", "95 % bootstrap CI", "published")
    table = Table(title, [Column(head, head) for head in heads], [], 1)
    rows = [find_published(side[0], published) for side in (ours, theirs)]
    for metric in list_metrics([*ours, *theirs]):
        compared = _compare(left_clips, right_clips, metric.name)
        if compared is None:
            continue
        left, right, (low, high) = compared
        first, second = (row.get(metric.name) for row in rows)
        digits = metric.digits + 1
        texts = [metric.heading, *(f"{value:.{digits}f}" for value in (left, right))]
        interval = "-" if math.isnan(low) else f"{low:+.{digits}f} to {high:+.{digits}f}"
        texts += [f"{left - right:+.{digits}f}", interval]
        change = None if first is None or second is None else first - second
        texts.append("-" if change is None else f"{change:+.{digits}f}")
        table.rows.append([TableCell(text=text) for text in texts])
    table.note = f"{len(left_clips[0])} clips; {len(ours)} runs against {len(theirs)}."
    if len(ours) != len(theirs) and 1 in (len(ours), len(theirs)):
        table.note += " The CI has no spread over seeds of the single run."
    table.note += _describe_conditions(find_differing_test_conditions(ours, theirs))
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
    heads = (*keys[:place], *keys[place + 1 :], "difference")
    table = Table(title, [*(Column(head, head) for head in heads), *metrics], [], len(heads))
    clips: set[int] = set()
    differing: set[str] = set()
    for others in rest:
        for pair in pairs:
            labels = [(*others[:place], name, *others[place:]) for name in pair]
            if not finished.keys() >= set(labels):
                continue
            ours, theirs = (finished[label] for label in labels)
            pooled = _pool_same_clips("pairs", ours, theirs)
            differing |= _find_other_conditions(keys[place], ours, theirs)
            texts = [*others, " − ".join(pair)]
            compared = [_compare(*pooled, metric.name) for metric in metrics]
            cells = [TableCell(c[0] - c[1], interval=c[2]) if c else TableCell() for c in compared]
            table.rows.append([*(TableCell(text=text) for text in texts), *cells])
            clips.add(len(pooled[0][0]))
    counts = " or ".join(map(str, sorted(clips)))
    table.note = f"{counts} test clips; mean (95 % bootstrap CI); bold: the CI excludes zero."
    table.note += _describe_conditions(differing)
    return table


def _describe_conditions(differing: set[str]) -> str:
    return f" Test conditions differ: {', '.join(sorted(differing))}." if differing else ""


def _find_other_conditions(setting: str, ours: Sequence[Run], theirs: Sequence[Run]) -> set[str]:
    """Return the test conditions that differ and are not part of `setting`, a key or a group."""
    found = find_differing_test_conditions(ours, theirs)
    return {key for key in found if key.split(".")[0] != setting.split(".")[0]}


def _choose_metrics(groups: Sequence[RunGroup], names: Sequence[str] | None) -> list[Column]:
    present = list_metrics(run for group in groups for run in group.runs)
    check_columns(names or (), [metric.name for metric in present])
    return [metric for metric in present if names is None or metric.name in names]


def _find_key_of_pair(groups: Sequence[RunGroup], pair: tuple[str, str]) -> int:
    """Return which of the labels takes both values of `pair`."""
    by_key = [set(labels) for labels in zip(*(group.label for group in groups), strict=True)]
    for place, labels in enumerate(by_key):
        if labels >= set(pair):
            return place
    listed = "; ".join(", ".join(sorted(labels)) for labels in by_key)
    raise ValueError(f"pairs must be two of the runs' settings ({listed}), got {list(pair)}")


def _pool_same_clips(
    keys: str, ours: Sequence[Run], theirs: Sequence[Run]
) -> tuple[ClipsOfRuns, ClipsOfRuns]:
    """Return the clips of every run of both sides, or, where those of each are drawn from another
    seed, of all as of one run.

    Raises ValueError, beginning with the `keys` of the config, unless all have the same clips.
    """
    runs = [*ours, *theirs]
    names = {tuple((clip["name"], clip.get("frames")) for clip in run.clips) for run in runs}
    if len(names) != 1 or () in names:
        raise ValueError(f"{keys} must hold the same clips, got {len(names)} sets of them")
    first, second = (sorted({run.test_seed for run in side}) for side in (ours, theirs))
    if first != second:
        raise ValueError(f"{keys} must have clips of the same seeds, got {first} and {second}")
    if len(first) > 1 and any(len(side) > len(first) for side in (ours, theirs)):
        raise ValueError(f"{keys} must hold one run for each seed of clips, got more of {first}")
    if len(first) == 1:
        return [run.clips for run in ours], [run.clips for run in theirs]
    left, right = (
        [clip for run in sorted(side, key=lambda run: run.test_seed) for clip in run.clips]
        for side in (ours, theirs)
    )
    return [left], [right]


def _compare(
    ours: ClipsOfRuns, theirs: ClipsOfRuns, metric: str
) -> tuple[float, float, tuple[float, float]] | None:
    """Return the mean of each side and the CI of their difference; None where a clip has no such
    score.
    """
    if not all(metric in clip for clips in [*ours, *theirs] for clip in clips):
        return None
    left, right = (
        [[float(clip[metric]) for clip in clips] for clips in side] for side in (ours, theirs)
    )
    weights = frame_weights(ours[0])
    interval = bootstrap_difference_interval(left, right, weights)
    if len(left[0]) == 1:  # of one clip there is none
        interval = math.nan, math.nan
    means = [fmean(fmean(row, weights) for row in side) for side in (left, right)]
    return means[0], means[1], interval
