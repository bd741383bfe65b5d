"""Runs that differ in their seed only are a cell; what was asked for and differs is its label."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from src.records.runs import Plan, Run

FIRST = ("task", "method", "experiment", "resolution", "postprocess", "baseline", "optics")
LAST = ("budget", "debug")


@dataclass
class Cell:
    """Runs of one setting, one per seed; `missing`: seeds of the sweep that have no results."""

    label: tuple[str, ...]
    runs: list[Run]
    missing: int = 0
    notes: list[str] = field(default_factory=list)


def cells(
    runs: list[Run], plans: list[Plan] = (), across: Iterable[str] = ()
) -> tuple[tuple[str, ...], list[Cell]]:
    """Return the keys of the labels, and a cell per setting, in the order of the sweeps.

    Like the seed, the settings `across` do not part cells, such as ckpt for networks of several
    seeds tested on the same clips.  Runs with one label and other settings are two cells, each with
    a note that says what differs.  Of two runs with one setting and seed the newer counts.
    """
    asked = [key for key in _asked(runs) if key not in across]
    keys = _telling([_values(run, asked) for run in runs])
    groups = defaultdict(list)
    for run in runs:
        label = tuple(_values(run, asked).get(key, "-") for key in keys)
        settings = {k: repr(v) for k, v in run.identity.items() if k not in across}
        groups[label, tuple(sorted(settings.items()))].append(run)
    made = [_cell(label, members, across) for (label, _), members in groups.items()]
    _mark(made)
    _count_missing(made, keys, [job for plan in plans for job in plan.jobs])
    return keys, made


def text(value: Any) -> str:
    """Return a setting as a person writes it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list):
        return "[" + ", ".join(map(text, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def matches(run: Run, when: dict) -> bool:
    """Return whether `run` was made with each choice or setting of `when`."""
    settings = {key: text(value) for key, value in run.settings.items()} | run.choices
    return all(settings.get(key) == text(value) for key, value in when.items())


def _asked(runs: list[Run]) -> list[str]:
    """Return the keys, not groups, that a command line of these runs has set."""
    keys = {_key(override) for run in runs for override in run.overrides}
    groups = {group for run in runs for group in run.choices}
    return sorted(keys - groups)


def _key(override: str) -> str:
    return override.split("=")[0].lstrip("+~").split("@")[0]


def _values(run: Run, asked: list[str]) -> dict[str, str]:
    """Return the choices, and of the keys asked for the settings, whatever set them."""
    values = {k: v for k, v in run.choices.items() if k not in LAST}
    for key in asked:
        inside = {k: v for k, v in run.identity.items() if k == key or k.startswith(key + ".")}
        if inside:
            values[key] = ", ".join(map(text, inside.values()))
    order = {key: place for place, key in enumerate(FIRST)}
    values = dict(sorted(values.items(), key=lambda item: order.get(item[0], len(FIRST))))
    return values | {k: v for k, v in run.choices.items() if k in LAST}


def _telling(rows: list[dict[str, str]]) -> tuple[str, ...]:
    """Return the fewest keys, taken in order, that tell apart all rows that differ."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    chosen, groups = [], 1
    for key in keys:
        split = len({tuple(row.get(k) for k in [*chosen, key]) for row in rows})
        if split > groups:
            chosen, groups = [*chosen, key], split
    return tuple(chosen) or ("experiment",)


def _cell(label: tuple[str, ...], runs: list[Run], across: Iterable[str]) -> Cell:
    newest = {}
    for run in runs:  # oldest first: the last one stays
        newest[run.record["seed"], *(str(run.settings.get(key)) for key in across)] = run
    cell = Cell(label, [newest[draw] for draw in sorted(newest)])
    if len(newest) < len(runs):
        cell.notes.append(f"{len(runs) - len(newest)} older runs of the same seeds are left out")
    return cell


def _mark(made: list[Cell]) -> None:
    alike = defaultdict(list)
    for cell in made:
        alike[cell.label].append(cell)
    for same in alike.values():
        if len(same) > 1:
            settings = [cell.runs[0].identity for cell in same]
            differing = _differing(settings)
            for cell, own in zip(same, settings, strict=True):
                said = ", ".join(f"{key} {text(own.get(key, '-'))}" for key in differing[:4])
                more = f" and {len(differing) - 4} more" if len(differing) > 4 else ""
                cell.notes.append(f"one of {len(same)} configurations of this cell: {said}{more}")


def _differing(settings: list[dict[str, Any]]) -> list[str]:
    keys = dict.fromkeys(key for one in settings for key in one)
    return [key for key in keys if len({repr(one.get(key, "-")) for one in settings}) > 1]


def _count_missing(made: list[Cell], keys: tuple[str, ...], jobs: Iterable[list[str]]) -> None:
    """Add to each cell, or as a new one, the jobs without results; sort by the jobs."""
    place = {}
    done = {frozenset(run.overrides) for cell in made for run in cell.runs}
    settings = {_seedless(run.overrides): cell for cell in made for run in cell.runs}
    for job in jobs:
        setting = _seedless(job)
        if setting in settings:
            place.setdefault(id(settings[setting]), len(place))
        if frozenset(job) in done:
            continue
        if setting not in settings:
            values = {_key(override): override.split("=", 1)[-1] for override in job}
            settings[setting] = Cell(tuple(values.get(key, "-") for key in keys), [])
            made.append(settings[setting])
            place[id(settings[setting])] = len(place)
        settings[setting].missing += 1
    made.sort(key=lambda cell: place.get(id(cell), len(place)))


def _seedless(overrides: list[str]) -> frozenset[str]:
    return frozenset(override for override in overrides if _key(override) != "seed")
