"""The chart's scores on the same clips, its knees, its tables and what they say in words."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields

import rich
import torch
from torch import nn

from src.bench.candidates import Candidate, Subject
from src.bench.pareto import knee
from src.bench.speed import FORMS, Speed
from src.metrics.scores import Scores
from src.metrics.table import METRICS
from src.models.fast import running
from src.records.results import csv_text
from src.sim.pipeline import Pipeline, simulate

SEVERITIES = ("weak", "medium", "strong", "mixed")


def check(sizes, threads, forms, devices, severities, clips: int) -> None:
    """Raise ValueError, naming the key, for what cannot be measured."""
    rules = {
        "sizes must be multiples of 8 from 16 on": all(s >= 16 and s % 8 == 0 for s in sizes),
        "threads must be numbers >= 1": all(count >= 1 for count in threads),
        f"forms must be of {', '.join(FORMS)}": set(forms) <= set(FORMS),
        "devices must be of cpu, cuda": set(devices) <= {"cpu", "cuda"},
        "severities must be of weak, medium, strong, mixed": set(severities) <= set(SEVERITIES),
    }
    given = (sizes, threads, forms, devices, severities)
    for (rule, kept), values in zip(rules.items(), given, strict=True):
        if not kept or not len(values):
            raise ValueError(f"{rule}, got {list(values)}")
    if clips < 1:
        raise ValueError(f"clips must be >= 1, got {clips}")


@dataclass(frozen=True)
class Score:
    """The scores of one network in one form on one clip."""

    network: str
    form: str
    severity: str
    clip: int
    values: Mapping[str, float]


@torch.no_grad()
def scores(
    candidates: Sequence[Candidate], pipelines: Mapping[str, Pipeline], clips: int,
    measure: Scores, *, warmup: int, forms: Sequence[str],
) -> list[Score]:  # fmt: skip
    """Return the scores of all trained networks on the same `clips` clips of every severity."""
    subjects = _subjects(candidates, forms)
    rows = []
    for severity, pipeline in pipelines.items():
        for clip in range(clips):
            sample = simulate(pipeline, [clip])
            windows, seconds = sample.voxels[0, :, None], float(sample.window_s[0])
            truth = sample.target[0, warmup:]
            for form, subject, restorer in subjects:
                frames, _ = subject.play(windows, list(sample.positions), seconds)
                if restorer is not None:
                    frames = restorer.restore(frames[None])[0]
                values = measure(frames[warmup:], truth)
                rows.append(Score(subject.name, form, severity, clip, values))
        rich.print(f"scored on {severity} turbulence")
    return rows


def _subjects(
    candidates: Sequence[Candidate], forms: Sequence[str]
) -> list[tuple[str, Subject, nn.Module | None]]:
    """Return (form, network, post-processor); what has one, or no weights, is not rounded."""
    subjects = []
    for candidate in candidates:
        if candidate.network is None or not candidate.trained:
            continue
        name, network, views = candidate.name, candidate.network, candidate.views
        subjects.append(("float32", Subject(name, network, views), candidate.restorer))
        learned = any(True for _ in network.parameters())
        if "bf16" in forms and learned and candidate.restorer is None:
            subjects.append(("bf16", Subject(name, running(network, "bf16"), views), None))
    return subjects


def knees(speeds: Sequence[Speed], scored: Sequence[Score], side: int) -> dict[str, str]:
    """Return for each severity the cheapest network within one standard error of the best.

    By LPIPS, else by 1 - SSIM; the cost is thread time in ms on pictures of `side`, float32.
    """
    which = (side, "float32", 1, "cpu")
    timed = [s for s in speeds if (s.side, s.form, s.threads, s.device) == which]
    costs = {s.network: s.ms for s in timed if s.ms}
    severities = dict.fromkeys(row.severity for row in scored)
    errors = {severity: _errors(scored, severity, costs) for severity in severities}
    return {severity: knee(costs, values) for severity, values in errors.items() if values}


def _errors(scored: Sequence[Score], severity: str, costs: Mapping) -> dict[str, list[float]]:
    errors: dict[str, list[float]] = {}
    for row in scored:
        if (row.severity, row.form) == (severity, "float32") and row.network in costs:
            error = row.values.get("lpips", 1 - row.values["ssim"])
            errors.setdefault(row.network, []).append(error)
    return errors


def words(
    speeds: Sequence[Speed], scored: Sequence[Score], knees: Mapping[str, str], side: int
) -> str:
    """Return the knees and a table of the means over all clips, as Markdown."""
    metrics = [metric for metric in METRICS if scored and metric.name in scored[0].values]
    heads = [metric.heading for metric in metrics]
    lines = ["# Speed against accuracy\n"]
    lines += [f"- {severity} turbulence: take {name}." for severity, name in knees.items()]
    lines += [
        f"\nMean over all clips; ms a frame of {side}x{side}, computed by one CPU thread.  "
        "Without scores: no weights, timed only.\n",
        "| " + " | ".join(["network", "form", "ms", "GMAC", "parameters", *heads]) + " |",
        "|---|---|" + "---:|" * (3 + len(metrics)),
    ]
    for s in speeds:
        if s.threads == 1 and s.side == side and s.device == "cpu":
            rows = [r.values for r in scored if (r.network, r.form) == (s.network, s.form)]
            means = [m.written(sum(r[m.name] for r in rows) / len(rows)) if rows else ""
                     for m in metrics]  # fmt: skip
            time = s.reason if s.ms is None else f"{s.ms:.2f}"
            size = [f"{s.gmac:.2f}" if s.gmac is not None else "", str(s.params or 0)]
            name = s.network + ("" if s.trained else " (no weights)")
            lines.append("| " + " | ".join([name, s.form, time, *size, *means]) + " |")
    return "\n".join(lines) + "\n"


def speed_csv(rows: Sequence[Speed]) -> str:
    """Return one line per entry."""
    return csv_text([field.name for field in fields(Speed)], [_short(astuple(row)) for row in rows])


def scores_csv(rows: Sequence[Score]) -> str:
    """Return one line per network, form and clip."""
    heads = ["network", "form", "severity", "clip", *(rows[0].values if rows else [])]
    lines = [[r.network, r.form, r.severity, r.clip, *r.values.values()] for r in rows]
    return csv_text(heads, map(_short, lines))


def _short(line: Iterable) -> list:
    return [f"{value:.6g}" if isinstance(value, float) else value for value in line]
