"""The table of differences between two sets of runs on the same clips."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from src.metrics.bootstrap import bootstrap_difference_interval
from src.metrics.table import Column
from src.records.results import frame_weights, list_sources
from src.records.runs import Run
from src.reports.clip_conditions import find_differing_test_conditions
from src.reports.notes import describe_conditions, describe_few_scenes, describe_runs
from src.reports.run_groups import RunGroup, find_published, group_runs
from src.reports.tables import Table, TableCell, list_metrics

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
    ours, theirs, left_out = keep_common_seeds(ours, theirs)
    left_clips, right_clips = pool_same_clips("run and against", ours, theirs)
    heads = ("metric", "ours", "theirs", "ours - theirs", "95 % bootstrap CI", "published")
    table = Table(title, [Column(head, head) for head in heads], [], 1)
    rows = [find_published(side[0], published) for side in (ours, theirs)]
    scenes = set[int]()
    for metric in list_metrics([*ours, *theirs]):
        compared = compare_clips(left_clips, right_clips, metric.name)
        if compared is None or (names is not None and metric.name not in names):
            continue
        scenes.add(compared.scenes)
        (left, right), (low, high) = (compared.ours, compared.theirs), compared.interval
        first, second = (row.get(metric.name) for row in rows)
        digits = metric.digits + 1
        texts = [metric.heading, *(f"{value:.{digits}f}" for value in (left, right))]
        interval = "-" if math.isnan(low) else f"{low:+.{digits}f} to {high:+.{digits}f}"
        texts += [f"{left - right:+.{digits}f}", interval]
        change = None if first is None or second is None else first - second
        texts.append("-" if change is None else f"{change:+.{digits}f}")
        table.rows.append([TableCell(text=text) for text in texts])
    table.note = f"{len(left_clips[0])} clips; {len(ours)} runs against {len(theirs)}.{left_out}"
    table.note += describe_few_scenes(scenes)
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


def keep_common_seeds(
    ours: Sequence[Run], theirs: Sequence[Run]
) -> tuple[list[Run], list[Run], str]:
    """Return the runs of both sides on clips of the seeds that both have, and a sentence that names
    the others; all runs where they share none."""
    first, second = ({run.test_seed for run in side} for side in (ours, theirs))
    if not first & second:
        return list(ours), list(theirs), ""
    kept = [[run for run in side if run.test_seed in first & second] for side in (ours, theirs)]
    left_out = ", ".join(map(str, sorted(first ^ second)))
    said = f" Left out: clips of seed {left_out}, which one side lacks." if left_out else ""
    return kept[0], kept[1], said


def pool_same_clips(
    keys: str, ours: Sequence[Run], theirs: Sequence[Run]
) -> tuple[ClipsOfRuns, ClipsOfRuns]:
    """Return the clips of every run of both sides, or, where those of each are drawn from another
    seed, of all as of one run.

    Raises ValueError, beginning with the `keys` of the config, unless all of a seed have the same
    clips.
    """
    first, second = (sorted({run.test_seed for run in side}) for side in (ours, theirs))
    if first != second:
        raise ValueError(f"{keys} must have clips of the same seeds, got {first} and {second}")
    runs = [*ours, *theirs]
    for seed in first:
        names = {_list_clip_names(run) for run in runs if run.test_seed == seed}
        if len(names) != 1 or () in names:
            raise ValueError(f"{keys} must hold the same clips, got {len(names)} sets of them")
    if len(first) > 1 and any(len(side) > len(first) for side in (ours, theirs)):
        raise ValueError(f"{keys} must hold one run for each seed of clips, got more of {first}")
    if len(first) == 1:
        return [run.clips for run in ours], [run.clips for run in theirs]
    left, right = (
        [clip for run in sorted(side, key=lambda run: run.test_seed) for clip in run.clips]
        for side in (ours, theirs)
    )
    return [left], [right]


def _list_clip_names(run: Run) -> tuple[tuple[str, str | None], ...]:
    """Return the name and the number of frames, if it is stated, of every clip."""
    return tuple((clip["name"], clip.get("frames")) for clip in run.clips)


@dataclass(frozen=True)
class Comparison:
    """The means of two sides over the same clips, the CI of their difference, and how many
    photographs or scenes it resamples."""

    ours: float
    theirs: float
    interval: tuple[float, float]
    scenes: int


def compare_clips(ours: ClipsOfRuns, theirs: ClipsOfRuns, metric: str) -> Comparison | None:
    """Compare the clips that have such a score in all runs; None where none has."""
    scored = [n for n, same in enumerate(zip(*ours, *theirs, strict=True))
              if all(metric in clip for clip in same)]  # fmt: skip
    if not scored:
        return None
    left, right = (
        [[float(clips[n][metric]) for n in scored] for clips in side] for side in (ours, theirs)
    )
    compared = [ours[0][n] for n in scored]
    weights, groups = frame_weights(compared), list_sources(compared)
    interval = bootstrap_difference_interval(left, right, weights, groups)
    first, second = (fmean(fmean(row, weights) for row in side) for side in (left, right))
    return Comparison(first, second, interval, len(set(groups)))
