"""The arguments of stress tests, checked before any of them runs, and titles that name them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

from src.bench.stress_tests.event_clips import ClipConditions
from src.sim.sensor import EventSensor
from src.sim.turbulence.plane_waves import WaveDynamics

Rule = tuple[str, Callable[[Any], object]]  # what is allowed, and whether a value is
CONDITIONS = [  # what `parameter`, `fixed` and `reference` may name
    *(f.name for f in fields(ClipConditions) if f.name not in ("turbulence", "sensor")),
    *(f"sensor.{f.name}" for f in fields(EventSensor)),
    *(f"turbulence.{f.name}" for f in fields(WaveDynamics)),
]


def check_arguments(key: str, function: str, given: Mapping[str, Any], fps: float) -> None:
    """Raise ValueError, which begins with the argument below `key` (stress_tests.<name>.test), for
    an argument `given` to the stress test `function` that it cannot run with.

    `fps`: windows a second of the clips.
    """
    for name, (allowed, rule) in _list_rules(function, given, fps).items():
        if name in given and not _is_allowed(rule, given[name]):
            raise ValueError(f"{key}.{name} must be {allowed}, got {given[name]}")


def fill_title(key: str, title: str, arguments: Mapping[str, Any]) -> str:
    """Return `title` with each {argument}, and {argument.least}, {argument.most} or {argument.last}
    of a list of numbers, in its place; raises ValueError, which begins with `key`, for others.
    """
    try:
        return title.format(**{name: _name_ends(value) for name, value in arguments.items()})
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        allowed = "{argument} or {list.least}, {list.most}, {list.last}"
        names = ", ".join(arguments)
        text = f"{key} must name arguments of its test as {allowed}, of {names}, got {title}"
        raise ValueError(text) from None


def _name_ends(value: Any) -> Any:
    """Return the ends of a list of numbers by their names; anything else as it is."""
    if not isinstance(value, Sequence) or not all(isinstance(v, int | float) for v in value):
        return value
    return SimpleNamespace(least=min(value), most=max(value), last=value[-1]) if value else value


def _list_rules(function: str, given: Mapping[str, Any], fps: float) -> dict[str, Rule]:
    """Return the rule of each argument that has one."""
    one_or_more: Rule = ("one or more", len)
    rules = dict.fromkeys(("values", "sizes", "jumps_ms", "spacings_over_aperture"), one_or_more)
    rules["shifts_px"] = one_or_more
    rules |= dict.fromkeys(("draws", "steps", "flicker_windows"), _at_least(1))
    rules["windows"] = _at_least(4 if "bf16" in function else 1)  # judged by quarters
    if "retention" in function:
        rules["windows"] = ("rising whole numbers >= 1", _are_rising_counts)
    rules["counts"] = ("whole numbers >= 1", _all(_at_least(1)[1]))
    rules["kept_shares"] = ("in (0, 1]", _all(lambda share: 0 < share <= 1))
    shifts = list(given.get("shifts_px", (1, 2, 4)))
    rules["judged_shift_px"] = (f"one of shifts_px, {shifts}", shifts.__contains__)
    allowed = f"such that they and fps={fps:g} are multiples of the lowest of all"
    rules["rates_hz"] = (allowed, lambda rates: rates and _are_multiples([fps, *rates]))
    listed = f"of {', '.join(CONDITIONS)}"
    rules["parameter"] = (listed, CONDITIONS.__contains__)
    named: Rule = (listed, lambda settings: set(settings or ()) <= set(CONDITIONS))
    return rules | {"fixed": named, "reference": named}


def _is_allowed(rule: Callable[[Any], object], value: Any) -> bool:
    try:
        return bool(rule(value))
    except TypeError:  # of another kind
        return False


def _at_least(least: int) -> Rule:
    return f"a whole number >= {least}", lambda value: int(value) == value >= least


def _all(rule: Callable[[Any], object]) -> Callable[[Any], bool]:
    return lambda values: len(values) > 0 and all(map(rule, values))


def _are_rising_counts(counts: Any) -> bool:
    return _all(lambda n: n >= 1 and n == int(n))(counts) and list(counts) == sorted(set(counts))


def _are_multiples(rates: list[float]) -> bool:
    ratios = [rate / min(rates) for rate in rates if min(rates) > 0]
    return len(ratios) == len(rates) and all(abs(r - round(r)) < 1e-6 for r in ratios)
