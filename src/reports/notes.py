"""What the note of a table says of its runs beside the numbers: what else differs, what is left
out."""

from collections.abc import Iterable, Sequence

from src.metrics.bootstrap import compute_interval_coverage
from src.records.runs import Run
from src.reports.clip_conditions import format_setting
from src.reports.run_groups import RunGroup, find_differing_defaults

MOST = 8  # names in a list
FEW_SCENES = 20  # below, the CIs of a table are said to be narrow


def describe_runs(keys: Sequence[str], groups: Sequence[RunGroup]) -> str:
    """Return sentences on the groups under labels of `keys`: older runs that are left out, over
    what they are means beside the seed, settings that differ unseen, versions of the code; ""
    where there is nothing to say."""
    runs = [run for group in groups for run in group.runs]
    older = sum(group.older for group in groups)
    said = f" {older} older runs of the same seeds are left out." if older else ""
    across = dict.fromkeys(key for group in groups for key in group.across)
    said += "".join(map(_describe_pooled, across, [runs] * len(across)))
    if unseen := find_differing_defaults(keys, groups):
        said += f" Settings differ that no command line names: {_join(unseen)}."
    commits = sorted({run.record["git"] for run in runs})
    return said + (f" The code differs: {_join(commits)}." if len(commits) > 1 else "")


def describe_conditions(differing: Iterable[str]) -> str:
    """Return a sentence that names the `differing` test conditions, "" for none."""
    named = sorted(differing)
    return f" Test conditions differ: {', '.join(named)}." if named else ""


def describe_few_scenes(counts: Iterable[int]) -> str:
    """Return a sentence on how often CIs hold the mean where they are over few scenes, the `counts`
    of photographs, videos or other clips that are resampled; "" where there are many, or one."""
    few = sorted({count for count in counts if 1 < count < FEW_SCENES})
    if not few:
        return ""
    held = dict.fromkeys(f"{100 * compute_interval_coverage(count):.0f}" for count in few)
    shown = " or ".join(map(str, few))
    return (
        f" Of {shown} photographs or scenes such a CI holds one seed's mean in about "
        f"{' or '.join(held)} % of cases."
    )


def _describe_pooled(key: str, runs: Sequence[Run]) -> str:
    values = list(dict.fromkeys(format_setting(run.settings.get(key)) for run in runs))
    return f" Means are over {key}: {_join(values)}." if len(values) > 1 else ""


def _join(names: Sequence[str]) -> str:
    more = [f"{len(names) - MOST} more"] if len(names) > MOST else []
    return ", ".join([*names[:MOST], *more])
