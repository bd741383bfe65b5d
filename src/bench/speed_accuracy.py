"""Scores of networks on the same clips, their Pareto front, and the tables of the chart."""

import math
import statistics
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import groupby
from typing import Any, TypeVar

import torch

from src.bench.candidates import Candidate
from src.bench.speed import TIMED_FORMS, SpeedMeasurement
from src.metrics.table import METRICS, NAMES, Column, mean_score
from src.metrics.video_metrics import VideoMetrics
from src.records.results import format_csv
from src.sim.pipeline import Pipeline, simulate

Name = TypeVar("Name", bound=Hashable)
LARGEST_SIDE = 4096  # pixels of a frame that is timed
SEVERITIES = ("weak", "medium", "strong", "mixed")


def check_chart_options(
    sizes, threads, forms, devices, severities, clips: int, seconds: float
) -> None:
    """Raise ValueError, naming the key, for what cannot be measured."""
    rules = {
        f"sizes must be multiples of 8 in 16..{LARGEST_SIDE}": (sizes, _is_side),
        "threads must be whole numbers >= 1": (threads, _is_count),
        f"forms must be of {', '.join(TIMED_FORMS)}": (forms, TIMED_FORMS.__contains__),
        "devices must be of cpu, cuda": (devices, ("cpu", "cuda").__contains__),
        f"severities must be of {', '.join(SEVERITIES)}": (severities, SEVERITIES.__contains__),
        "clips must be >= 1": ([clips], _is_count),
        "seconds must be > 0": ([seconds], lambda value: 0 < value < math.inf),
    }
    for rule, (values, is_allowed) in rules.items():
        if not len(values) or not all(map(is_allowed, values)):
            raise ValueError(f"{rule}, got {', '.join(map(str, values)) or 'none'}")
    for key, needed, values in (("threads", 1, threads), ("devices", "cpu", devices)):
        if needed not in values:  # find_fastest_forms
            listed = ", ".join(map(str, values))
            why = "networks are compared by the time of one CPU thread"
            raise ValueError(f"{key} must include {needed}, got {listed}: {why}")


def _is_count(count: object) -> bool:
    return isinstance(count, int) and count >= 1


def _is_side(side: object) -> bool:
    return isinstance(side, int) and 16 <= side <= LARGEST_SIDE and side % 8 == 0


@dataclass(frozen=True)
class ClipScore:
    """The scores of one network on one clip, None for one that the clip does not have."""

    network: str
    severity: str
    clip: int
    values: Mapping[str, Any]


@torch.no_grad()
def score_accuracy(
    candidates: Sequence[Candidate], pipelines: Mapping[str, Pipeline], clips: int,
    measure: VideoMetrics, *, warmup: int,
) -> list[ClipScore]:  # fmt: skip
    """Return the scores of all trained networks, in float32, on the same `clips` clips of every
    severity.
    """
    trained, scores = [one for one in candidates if one.network is not None and one.trained], []
    for severity, pipeline in pipelines.items():
        for clip in range(clips):
            sample = simulate(pipeline, [clip])
            windows, window_s = sample.voxels[0, :, None], float(sample.window_s[0])
            truth = sample.target[0, warmup:]
            for candidate in trained:
                frames, _ = candidate.reconstruct(windows, list(sample.positions or ()), window_s)
                values = measure(frames[warmup:], truth)
                scores.append(ClipScore(candidate.name, severity, clip, values))
        print(f"scored on {severity} turbulence")
    return scores


def find_fastest_forms(
    speeds: Sequence[SpeedMeasurement], side: int
) -> dict[str, SpeedMeasurement]:
    """Return each network's fastest form on frames of `side`, by one CPU thread's time."""
    timed = [s for s in speeds if s.ms and (s.side, s.threads, s.device) == (side, 1, "cpu")]
    slowest_first = sorted(timed, key=lambda s: s.ms or 0.0, reverse=True)
    return {s.network: s for s in slowest_first}


def find_pareto_front(costs_and_errors: Mapping[Name, tuple[float, float]]) -> list[Name]:
    """Return the names, cheapest first, of the (cost, error) that none beats in both."""
    names, least = [], math.inf
    for name, (_, error) in sorted(costs_and_errors.items(), key=lambda item: item[1]):
        if error < least:
            names.append(name)
            least = error
    return names


def compute_standard_error(values: Sequence[float]) -> float:
    """Return the standard error of the mean of two values or more."""
    return statistics.stdev(values) / math.sqrt(len(values))


def select_by_one_standard_error(
    costs: Mapping[str, float], errors: Mapping[str, Sequence[float]]
) -> str:
    """Return the cheapest network whose mean error is within one standard error of the best (the
    rule of Breiman et al. 1984); `errors` are of the same two clips or more, the standard error
    that of the difference to the best.
    """
    best = min(errors, key=lambda name: statistics.fmean(errors[name]))

    def is_near(values: Sequence[float]) -> bool:
        more = [ours - least for ours, least in zip(values, errors[best], strict=True)]
        return statistics.fmean(more) <= compute_standard_error(more)

    return min((name for name in errors if is_near(errors[name])), key=costs.__getitem__)


def find_networks_without_score(scores: Sequence[ClipScore]) -> dict[str, list[str]]:
    """Return {severity: the networks whose error is not finite on one of its clips or more}."""
    found: dict[str, list[str]] = {}
    for score in scores:
        row = found.setdefault(score.severity, [])
        if not math.isfinite(_error(score)) and score.network not in row:
            row.append(score.network)
    return {severity: networks for severity, networks in found.items() if networks}


def _error(score: ClipScore) -> float:
    """Return LPIPS, else 1 - SSIM; NaN of a clip that has none."""
    ssim = score.values.get("ssim")
    error = score.values.get("lpips", None if ssim is None else 1 - ssim)
    return math.nan if error is None else error


def recommend_network_per_severity(
    speeds: Sequence[SpeedMeasurement], scores: Sequence[ClipScore], side: int
) -> dict[str, str]:
    """Return {severity: the cheapest network within one standard error of the best}, none for
    fewer than two clips, of which there is no standard error.

    By LPIPS, else by 1 - SSIM; a network without a finite one on every clip is left out.  The cost
    is the thread time in ms on frames of `side`, in the fastest form.
    """
    costs = {name: s.ms or math.inf for name, s in find_fastest_forms(speeds, side).items()}
    errors: dict[str, dict[str, list[float]]] = {}
    left_out = find_networks_without_score(scores)
    for score in scores:
        row = errors.setdefault(score.severity, {})
        if score.network in costs and score.network not in left_out.get(score.severity, ()):
            row.setdefault(score.network, []).append(_error(score))
    return {
        name: select_by_one_standard_error(costs, row)
        for name, row in errors.items()
        if min(map(len, row.values()), default=0) > 1
    }


def format_chart_summary(
    speeds: Sequence[SpeedMeasurement], scores: Sequence[ClipScore],
    recommended: Mapping[str, str], side: int,
) -> str:  # fmt: skip
    """Return the recommended networks and a table of means over all clips, as Markdown."""
    values, fastest = scores[0].values if scores else {}, find_fastest_forms(speeds, side)
    metrics = [metric for metric in METRICS if metric.name in values]
    metrics += [Column(name, name, 3) for name in values if name not in NAMES]
    heads = [metric.heading for metric in metrics]
    threads = sorted({s.threads for s in speeds if s.device == "cpu"})
    times = [f"ms, {count} thread{'s' * (count > 1)}" for count in threads]
    lines = ["# Speed against accuracy\n"]
    lines += [f"- {severity} turbulence: take {name}." for severity, name in recommended.items()]
    for severity, networks in find_networks_without_score(scores).items():
        names = ", ".join(networks)
        lines.append(f"- {severity} turbulence: not every clip has a finite score of {names}.")
    lines += [
        f"\nMs from events to a frame of {side}x{side}; in rows of the form that is fastest on one "
        "thread the means over all clips, in float32.  No weights: timed only.\n",
        "| " + " | ".join(["network", "form", *times, "GMAC", "parameters", *heads]) + " |",
        "|---|---|" + "---:|" * (len(times) + 2 + len(metrics)),
    ]
    here = [s for s in speeds if (s.side, s.device) == (side, "cpu")]
    for (network, form), group in groupby(here, lambda s: (s.network, s.form)):
        by_threads = {s.threads: s for s in group}
        first = next(iter(by_threads.values()))
        is_fastest = fastest.get(network) in by_threads.values()
        rows = [r.values for r in scores if is_fastest and r.network == network]
        means = [m.format_value(mean_score(r[m.name] for r in rows)) if rows else ""
                 for m in metrics]  # fmt: skip
        took = [_format_time(by_threads.get(count)) for count in threads]
        size = [f"{first.gmac:.2f}" if first.gmac is not None else "", str(first.params or 0)]
        name = network + ("" if first.trained else " (no weights)")
        lines.append("| " + " | ".join([name, form, *took, *size, *means]) + " |")
    return "\n".join(lines) + "\n"


def _format_time(timed: SpeedMeasurement | None) -> str:
    if timed is None or timed.ms is None:
        return timed.reason if timed else ""
    return f"{timed.ms:.2f}"


def format_speeds_csv(rows: Sequence[SpeedMeasurement]) -> str:
    """Return one line per measurement."""
    return format_csv([field.name for field in fields(SpeedMeasurement)], map(astuple, rows))


def format_scores_csv(rows: Sequence[ClipScore]) -> str:
    """Return one line per network and clip."""
    heads = ["network", "severity", "clip", *(rows[0].values if rows else [])]
    lines = [[r.network, r.severity, r.clip, *r.values.values()] for r in rows]
    return format_csv(heads, lines)
