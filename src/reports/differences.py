"""Tables of differences on the same clips: of two sets of runs, and of pairs of a sweep's runs."""

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

from src.metrics.bootstrap import bootstrap_difference_interval
from src.metrics.table import Column
from src.records.results import frame_weights
from src.records.runs import Run
from src.reports.clip_conditions import find_differing_test_conditions, is_test_condition
from src.reports.notes import describe_conditions, describe_runs
from src.reports.run_groups import RunGroup, find_published, group_runs
from src.reports.tables import Table, TableCell, check_columns, list_metrics

ClipsOfRuns = list[list[dict[str, str]]]


def build_difference_table(
    title: str, ours: Sequence[Run], theirs: Sequence[Run], published: Mapping[str, Any],
    across: Sequence[str] = (), names: Sequence[str] | None = None,
) -> Table:  # fmt: skip
    """Return the means of `ours` and `theirs`, a run per seed, and their difference with the 95 %
    CI (`bootstrap_difference_interval`); beside it the published difference.  `across`: settings
    that are averaged over as the seed is; `names`: of the metrics, None: all.  A note names the
    settings and the test conditions that differ, and seeds of clips that one side lacks.

    Raises ValueError where the clips of all runs are not the same.
    """
    settings, groups = group_runs([ours[0], theirs[0]], across=across)
    ours, theirs, left_out = _keep_common_seeds("run and against", ours, theirs)
    left_clips, right_clips = _pool_same_clips("run and against", ours, theirs)
    heads = ("metric", "ours", "theirs", "ours - theirs", "95 % bootstrap CI", "published")
    table = Table(title, [Column(head, head) for head in heads], [], 1)
    rows = [find_published(side[0], published) for side in (ours, theirs)]
    for metric in list_metrics([*ours, *theirs]):
        compared = _compare(left_clips, right_clips, metric.name)
        if compared is None or (names is not None and metric.name not in names):
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
    table.note = f"{len(left_clips[0])} clips; {len(ours)} runs against {len(theirs)}.{left_out}"
    if len(ours) != len(theirs) and 1 in (len(ours), len(theirs)):
        table.note += " The CI has no spread over seeds of the single run."
    labels = list(zip(settings, *(group.label for group in groups), strict=True))
    if len(groups) == 2:
        named = ", ".join(f"{key} {left} against {right}" for key, left, right in labels)
        table.note += f" Settings: {named}."
    sides = [RunGroup((), list(side), across=tuple(across)) for side in (ours, theirs)]
    table.note += describe_conditions(find_differing_test_conditions(ours, theirs))
    table.note += describe_runs(settings, sides)
    return table


def build_pair_table(
    title: str,
    keys: Sequence[str],
    groups: Sequence[RunGroup],
    pairs: Sequence[tuple[str, str]],
    names: Sequence[str] | None = None,
) -> Table:
    """Return A - B, with the 95 % bootstrap CI, for each of `pairs` = (A, B) of labels, such as two
    methods, in a row for every value of the other settings; "missing" where one of them has no
    results.  A setting that goes with the pair, such as optics with ckpt, is in the row as A - B,
    too.  `names`: of the metrics, None: all.

    Raises ValueError for a metric or a pair that is none, where the clips of a pair differ, and
    where no pair has results of both.
    """
    metrics = _choose_metrics(groups, names)
    places = [_find_key_of_pair(groups, pair) for pair in pairs]
    place = places[0]
    if len(set(places)) > 1:
        raise ValueError(f"pairs must be of one setting, got {', '.join(keys[k] for k in places)}")
    heads = (*keys[:place], *keys[place + 1 :], "difference")
    table = Table(title, [*(Column(head, head) for head in heads), *metrics], [], len(heads))
    clips: set[int] = set()
    said: dict[str, None] = {}
    compared_groups: list[RunGroup] = []
    for pair, sides in _pair_groups(keys, groups, place, pairs):
        texts = _label_pair(place, pair, sides)
        both = [side for side in sides if side is not None and side.runs]
        if len(both) < 2:
            cells = [TableCell(text="missing") for _ in metrics]
        else:
            ours, theirs, left_out = _keep_common_seeds("pairs", *(side.runs for side in both))
            pooled = _pool_same_clips("pairs", ours, theirs)
            differing = _find_other_conditions(keys[place], ours, theirs)
            said |= dict.fromkeys([left_out, describe_conditions(differing)])
            compared = [_compare(*pooled, metric.name) for metric in metrics]
            cells = [TableCell(c[0] - c[1], interval=c[2]) if c else TableCell() for c in compared]
            clips.add(len(pooled[0][0]))
            compared_groups += both
        table.rows.append([*(TableCell(text=text) for text in texts), *cells])
    if not clips:
        listed = "; ".join(" and ".join(pair) for pair in pairs)
        raise ValueError(f"pairs must have results of both on the same clips, got none of {listed}")
    counts = " or ".join(map(str, sorted(clips)))
    table.note = f"{counts} test clips; mean (95 % bootstrap CI); bold: the CI excludes zero."
    table.note += "".join(said) + describe_runs(keys, compared_groups)
    return table


def _pair_groups(
    keys: Sequence[str], groups: Sequence[RunGroup], place: int, pairs: Sequence[tuple[str, str]]
) -> Iterator[tuple[tuple[str, str], list[RunGroup | None]]]:
    """Return each of `pairs` with its two groups, None for one that is not there, for every value
    of the settings that do not go with it."""
    bound = {pair: _find_bound_keys(keys, groups, place, pair) for pair in pairs}

    def get_others(label: tuple[str, ...], pair: tuple[str, str]) -> tuple[str, ...]:
        return tuple(v for k, v in enumerate(label) if k != place and k not in bound[pair])

    found = {(pair, group.label[place], get_others(group.label, pair)): group
             for pair in pairs for group in groups}  # fmt: skip
    rows = dict.fromkeys((get_others(g.label, pair), pair) for g in groups for pair in pairs)
    for others, pair in rows:
        sides = [found.get((pair, name, others)) for name in pair]
        if any(sides):
            yield pair, sides


def _find_bound_keys(
    keys: Sequence[str], groups: Sequence[RunGroup], place: int, pair: tuple[str, str]
) -> set[int]:
    """Return the places of settings that go with `pair`: each side has one value, another than the
    other side's.  Test conditions never do."""
    sides = [[group.label for group in groups if group.label[place] == name] for name in pair]
    bound = set()
    for k in (k for k, key in enumerate(keys) if k != place and not is_test_condition(key)):
        ours, theirs = ({label[k] for label in side} for side in sides)
        if len(ours) == len(theirs) == 1 and ours != theirs:
            bound.add(k)
    return bound


def _label_pair(place: int, pair: tuple[str, str], sides: Sequence[RunGroup | None]) -> list[str]:
    """Return the labels of a row: the value of every other setting, or both, and the pair."""
    labels = [side.label for side in sides if side is not None]
    values = [dict.fromkeys(texts) for texts in zip(*labels, strict=True)]
    return [" − ".join(v) for k, v in enumerate(values) if k != place] + [" − ".join(pair)]


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


def _keep_common_seeds(
    keys: str, ours: Sequence[Run], theirs: Sequence[Run]
) -> tuple[list[Run], list[Run], str]:
    """Return the runs of both sides on clips of the seeds that both have, and a sentence that names
    the others; ValueError, beginning with the `keys` of the config, where they share none."""
    first, second = ({run.test_seed for run in side} for side in (ours, theirs))
    if not first & second:
        got = f"{sorted(first)} and {sorted(second)}"
        raise ValueError(f"{keys} must have clips of the same seeds, got {got}")
    kept = [[run for run in side if run.test_seed in first & second] for side in (ours, theirs)]
    left_out = ", ".join(map(str, sorted(first ^ second)))
    said = f" Left out: clips of seed {left_out}, which one side lacks." if left_out else ""
    return kept[0], kept[1], said


def _pool_same_clips(
    keys: str, ours: Sequence[Run], theirs: Sequence[Run]
) -> tuple[ClipsOfRuns, ClipsOfRuns]:
    """Return the clips of every run of both sides, whose seeds of clips are the same, or, where
    there are several of them, of all as of one run.

    Raises ValueError, beginning with the `keys` of the config, unless all have the same clips.
    """
    runs = [*ours, *theirs]
    names = {tuple((clip["name"], clip.get("frames")) for clip in run.clips) for run in runs}
    if len(names) != 1 or () in names:
        raise ValueError(f"{keys} must hold the same clips, got {len(names)} sets of them")
    seeds = sorted({run.test_seed for run in runs})
    if len(seeds) == 1:
        return [run.clips for run in ours], [run.clips for run in theirs]
    if any(len(side) > len(seeds) for side in (ours, theirs)):
        raise ValueError(f"{keys} must hold one run for each seed of clips, got more of {seeds}")
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
