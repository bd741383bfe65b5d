"""Runs that differ in their seed only form a group, labelled by the settings that tell it apart."""

from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import yaml

from src.records import safe_yaml
from src.records.overrides import read_override_key
from src.records.runs import Run, SweepPlan, is_result_setting
from src.reports.clip_conditions import format_setting, list_settings, list_test_conditions

FIRST_KEYS = ("task", "method", "experiment", "resolution", "postprocess", "baseline", "optics")
LAST_KEYS = ("budget", "debug")


@dataclass
class RunGroup:
    """Runs of one setting, one per seed.

    `missing`: seeds of the sweep that have no results; `older`: runs of a seed that has
    a newer one; `across`: settings in which the runs may differ beside the seed.
    """

    label: tuple[str, ...]
    runs: list[Run]
    missing: int = 0
    older: int = 0
    across: tuple[str, ...] = ()

    @cached_property
    def test_conditions(self) -> frozenset[tuple[str, str]]:
        """The settings and seeds that the test clips follow from: scores of groups in which they
        are equal can be compared.
        """
        return list_test_conditions(self.runs)

    @cached_property
    def frame_sizes_and_devices(self) -> tuple:
        """The sizes of the timed frames and the devices."""
        sizes = frozenset(size for run in self.runs for size in run.record["latency_ms"])
        return sizes, frozenset(run.record["device"] for run in self.runs)

    def list_comparison_conditions(self, column: str) -> tuple:
        """What must be equal for values of a column to be compared: of times, frames and devices;
        of scores, test conditions, and arguments where a config has added the metric.
        """
        if column == "ms":
            return self.frame_sizes_and_devices
        return self.test_conditions, list_settings(self.runs, f"metrics.{column}.")


def group_runs(
    runs: Sequence[Run], plans: Sequence[SweepPlan] = (), across: Sequence[str] = ()
) -> tuple[tuple[str, ...], list[RunGroup]]:
    """Return the keys of the labels, and a group per setting, in the order of the sweeps.

    The keys are all that command lines have set and that differ, in jobs without results too, then
    the fewest other choices and settings that tell the groups apart.  Like the seeds, the settings
    `across` do not part groups, such as ckpt for networks of several seeds tested on the same
    clips.  Of two runs with one setting and the same seeds the newer counts.
    """
    overridden = sorted({read_override_key(override) for run in runs for override in run.overrides})
    rows = [_label_values(run, overridden, across) for run in runs]
    keys = _distinguishing_keys(rows, overridden, _find_planned_keys(runs, plans, across))
    groups: dict[tuple[str, ...], RunGroup] = {}
    newest: dict[tuple[str, ...], dict[tuple, Run]] = defaultdict(dict)
    for run, row in zip(runs, rows, strict=True):  # oldest first: the last one stays
        label = tuple(row.get(key, "-") for key in keys)
        draw = run.record["seed"], run.test_seed, *(str(run.settings.get(key)) for key in across)
        groups.setdefault(label, RunGroup(label, [], across=tuple(across))).older += (
            draw in newest[label]
        )
        newest[label][draw] = run
    for label, group in groups.items():
        group.runs = [run for _, run in sorted(newest[label].items())]
    return keys, _count_missing(list(groups.values()), keys, plans)


def require_one_setting(key: str, runs: Sequence[Run], across: Sequence[str] = ()) -> list[Run]:
    """Return the runs, one per seed, of the one setting that `runs` are of.

    Raises ValueError, with the `key` of the config, where they are of several.
    """
    keys, groups = group_runs(runs, across=across)
    if len(groups) == 1:
        return groups[0].runs
    listed = "; ".join(", ".join(group.label) for group in groups)
    got = f"{', '.join(keys)} of {listed} (across names what may differ)" if groups else "no runs"
    raise ValueError(f"{key} must be runs of one setting with against, got {got}")


def check_across(across: Sequence[str], runs: Sequence[Run]) -> None:
    """Raise ValueError for a key of `across` that no run has."""
    for key in across:
        if not any(key in run.settings for run in runs):
            raise ValueError(f"across must be settings of the runs, such as ckpt, got {key}")


def find_differing_defaults(keys: Sequence[str], groups: Sequence[RunGroup]) -> list[str]:
    """Return the settings beside `keys` that differ between groups of equal choices and command
    lines, as those of another version's defaults do."""
    alike: dict[tuple, list[Run]] = defaultdict(list)
    for run in (group.runs[0] for group in groups if group.runs):
        alike[frozenset(run.choices.items()), _without_seed(run.overrides)].append(run)
    found = set[str]()
    for first, *others in alike.values():
        for other in others:
            sides = (run.result_settings_without_seed.items() for run in (first, other))
            ours, theirs = ({(key, format_setting(value)) for key, value in side} for side in sides)
            found |= {key for key, _ in ours ^ theirs}
    hidden = {*keys, *(key for group in groups for key in group.across)}
    return sorted(key for key in found if not any(f"{key}.".startswith(f"{k}.") for k in hidden))


def find_published(run: Run, published: Mapping[str, Any]) -> dict[str, float]:
    """Return {metric: value} of the row of `published` that fits the run best; {} without one.

    `published`: {rows: [{when: {key: value}, metric: value ...}]}; a row fits a run with each
    choice or setting of its `when`.
    """
    settings = {key: format_setting(value) for key, value in run.settings.items()} | run.choices

    def fits(row: dict) -> bool:
        return all(settings.get(key) == format_setting(value) for key, value in row["when"].items())

    fitting = filter(fits, published["rows"])
    best: dict = max(fitting, key=lambda row: len(row["when"]), default={})
    return {metric: value for metric, value in best.items() if metric != "when"}


def _place(key: str) -> int:
    """Return the place of a key in labels."""
    return FIRST_KEYS.index(key) if key in FIRST_KEYS else len(FIRST_KEYS)


def _override_value(override: str) -> str:
    """Return the value as `format_setting` writes it."""
    text = override.split("=", 1)[-1]
    if not text.startswith(tuple("[-.0123456789")):  # `on` is a name, not true
        return text
    try:
        return format_setting(safe_yaml.parse(text))
    except yaml.YAMLError:
        return text


def _label_values(run: Run, overridden: Sequence[str], across: Sequence[str]) -> dict[str, str]:
    """Return the choices, the settings of the `overridden` keys, and all other settings."""
    first = {k: v for k, v in run.choices.items() if k not in LAST_KEYS}
    settings = {
        k: format_setting(v) for k, v in run.result_settings_without_seed.items() if k not in across
    }
    for key in (key for key in overridden if key not in (*run.choices, *across)):
        inside = [v for k, v in settings.items() if k == key or k.startswith(key + ".")]
        first |= {key: ", ".join(inside)} if inside else {}
    first = dict(sorted(first.items(), key=lambda item: _place(item[0])))
    last = {k: v for k, v in run.choices.items() if k in LAST_KEYS}
    return first | last | {k: v for k, v in settings.items() if k not in first}


def _find_planned_keys(
    runs: Sequence[Run], plans: Sequence[SweepPlan], across: Sequence[str]
) -> set[str]:
    """Return the keys that tell the jobs of `plans` apart as settings of results; none where all
    jobs have results."""
    jobs = [job for plan in plans for job in plan.jobs]
    if {frozenset(job) for job in jobs} <= {frozenset(run.overrides) for run in runs}:
        return set()
    values = [{read_override_key(one): _override_value(one) for one in job} for job in jobs]
    keys = {key for job in values for key in job if len({one.get(key) for one in values}) > 1}
    train = any(run.record["task"] == "train" for run in runs)
    return {key for key in keys if key not in across and is_result_setting(key, train)}


def _distinguishing_keys(
    rows: Sequence[dict[str, str]], overridden: Sequence[str], planned: Set[str]
) -> tuple[str, ...]:
    """Return the `planned` keys, the `overridden` ones whose values differ, and the fewest others,
    taken in order, that tell apart all rows that differ."""
    ordered = sorted(planned, key=lambda key: (_place(key), key))
    present = dict.fromkeys([*(key for row in rows for key in row), *ordered])
    differing = {key for key in present if len({row.get(key) for row in rows}) > 1}
    varying = [key for key in present if key in differing | planned]
    chosen = {key for key in varying if key in overridden or key in planned}

    def count(chosen: set[str]) -> int:
        return len({tuple(row.get(key) for key in varying if key in chosen) for row in rows})

    for key in varying:
        if count(chosen | {key}) > count(chosen):
            chosen.add(key)
    return tuple(key for key in varying if key in chosen) or ("experiment",)


def _count_missing(
    groups: list[RunGroup], keys: tuple[str, ...], plans: Sequence[SweepPlan]
) -> list[RunGroup]:
    """Add to each group, or as a new one, the jobs without results; return them as the jobs go."""
    done = {frozenset(run.overrides) for group in groups for run in group.runs}
    by_setting = {_without_seed(run.overrides): group for group in groups for run in group.runs}
    ordered: dict[int, RunGroup] = {}
    for job in (job for plan in plans for job in plan.jobs):
        values = {read_override_key(override): _override_value(override) for override in job}
        new = RunGroup(tuple(values.get(key, "-") for key in keys), [])
        group = by_setting.setdefault(_without_seed(job), new)
        group.missing += frozenset(job) not in done
        ordered[id(group)] = group
    return list((ordered | {id(group): group for group in groups}).values())


def _without_seed(overrides: Sequence[str]) -> frozenset[str]:
    return frozenset(override for override in overrides if read_override_key(override) != "seed")
