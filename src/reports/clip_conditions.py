"""The test conditions of runs: the settings and seeds that their clips and scores follow from."""

from collections.abc import Sequence
from typing import Any

from src.records.runs import Run

# A key, or the beginning of several.
TEST_CONDITIONS = (
    "scene.", "turbulence.", "sensor.", "fps", "metrics.resolution_scale",
    "metrics.jitter_reduction", "metrics.lpips.",
    "data.test_", "data.unscored_windows", "data.substeps", "data.benchmark", "data.window",
    "data.events_per_window", "data.max_grid_s", "data.tolerance_ms", "data.start_s", "data.end_s",
    "data.warm_up_s", "data.histogram", "data.sequences.",
)  # fmt: skip
NO_CONDITIONS = (  # the first is told by the run, the others are of training
    "data.test_seed", "data.windows", "scene.extra_train_root",
)  # fmt: skip


def list_test_conditions(runs: Sequence[Run]) -> frozenset[tuple[str, str]]:
    """Return (key, value) of every setting of `runs` that test clips follow from."""
    found = {item for item in list_settings(runs, TEST_CONDITIONS) if item[0] not in NO_CONDITIONS}
    return frozenset(found | {("data.test_seed", str(run.test_seed)) for run in runs})


def list_settings(
    runs: Sequence[Run], beginnings: str | tuple[str, ...]
) -> frozenset[tuple[str, str]]:
    """Return (key, value) of every setting of `runs` whose key has one of `beginnings`."""
    return frozenset(
        (key, format_setting(value))
        for run in runs
        for key, value in run.settings.items()
        if key.startswith(beginnings)
    )


def find_differing_test_conditions(ours: Sequence[Run], theirs: Sequence[Run]) -> set[str]:
    """Return the keys of the test conditions that are not the same on both sides; those of a metric
    that a config has added are conditions where both sides have it."""
    names = [{name for run in side for name in run.record.get("own_metrics", {})}
             for side in (ours, theirs)]  # fmt: skip
    own = tuple(f"metrics.{name}." for name in names[0] & names[1])
    differing = list_test_conditions(ours) ^ list_test_conditions(theirs)
    differing |= list_settings(ours, own) ^ list_settings(theirs, own)
    return {key for key, _ in differing}


def is_test_condition(key: str) -> bool:
    """Return whether a key, or the choice of a config group, sets test conditions."""
    return any(one.startswith(f"{key}.") or key.startswith(one) for one in TEST_CONDITIONS)


def format_setting(value: Any) -> str:
    """Return a setting as a person writes it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list):
        return "[" + ", ".join(map(format_setting, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
