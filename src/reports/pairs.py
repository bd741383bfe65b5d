"""The table of differences between pairs of a sweep's runs, row by row of the other settings."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from src.metrics.table import Column
from src.records.runs import Run
from src.reports.clip_conditions import find_differing_test_conditions, is_test_condition
from src.reports.differences import compare_clips, keep_common_seeds, pool_same_clips
from src.reports.notes import describe_conditions, describe_few_scenes, describe_runs
from src.reports.run_groups import RunGroup
from src.reports.tables import Table, TableCell, check_columns, list_metrics


@dataclass
class _Difference:
    """The cells of a row, a metric each; the number of clips, 0 where a side is missing, those
    of photographs or scenes that the cells resample; sentences on the two groups.
    """

    cells: list[TableCell]
    clips: int = 0
    scenes: set[int] = field(default_factory=set)
    note: str = ""
    groups: list[RunGroup] = field(default_factory=list)


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
    compared = [
        (_label_pair(place, pair, sides), _compare_pair(keys[place], sides, metrics))
        for pair, sides in _pair_groups(keys, groups, place, pairs)
    ]
    for texts, difference in compared:
        table.rows.append([*(TableCell(text=text) for text in texts), *difference.cells])
    counts = sorted({difference.clips for _, difference in compared} - {0})
    if not counts:
        listed = "; ".join(" and ".join(pair) for pair in pairs)
        raise ValueError(f"pairs must have results of both on the same clips, got none of {listed}")
    table.note = f"{' or '.join(map(str, counts))} test clips; mean (95 % bootstrap CI); "
    table.note += "bold: the CI excludes zero."
    table.note += describe_few_scenes({n for _, difference in compared for n in difference.scenes})
    table.note += "".join(dict.fromkeys(difference.note for _, difference in compared))
    finished = {id(group): group for _, difference in compared for group in difference.groups}
    table.note += describe_runs(keys, list(finished.values()))
    return table


def _compare_pair(
    setting: str, sides: Sequence[RunGroup | None], metrics: Sequence[Column]
) -> _Difference:
    """Return the difference of the two groups of a row, "missing" where one has no results."""
    both = [side for side in sides if side is not None and side.runs]
    if len(both) < 2:
        return _Difference([TableCell(text="missing") for _ in metrics])
    ours, theirs, left_out = keep_common_seeds(*(side.runs for side in both))
    pooled = pool_same_clips("pairs", ours, theirs)
    found = [compare_clips(*pooled, metric.name) for metric in metrics]
    cells = [TableCell(f.ours - f.theirs, interval=f.interval) if f else TableCell() for f in found]
    note = left_out + describe_conditions(_find_other_conditions(setting, ours, theirs))
    scenes = {f.scenes for f in found if f}
    return _Difference(cells, len(pooled[0][0]), scenes, note, both)


def _pair_groups(
    keys: Sequence[str], groups: Sequence[RunGroup], place: int, pairs: Sequence[tuple[str, str]]
) -> Iterator[tuple[tuple[str, str], list[RunGroup | None]]]:
    """Return each of `pairs` with its two groups, None for one that is not there, for every value
    of the settings that do not go with it."""
    bound = {pair: _find_bound_keys(keys, groups, place, pair) for pair in pairs}

    def get_others(label: tuple[str, ...], pair: tuple[str, str]) -> tuple[str, ...]:
        return tuple(v for k, v in enumerate(label) if k != place and k not in bound[pair])

    finished_last = sorted(groups, key=lambda group: bool(group.runs))  # they replace the others
    found = {(pair, group.label[place], get_others(group.label, pair)): group
             for pair in pairs for group in finished_last}  # fmt: skip
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
