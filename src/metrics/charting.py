"""What the chart shows: speed of every network in every form, and its scores on the same clips."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import rich
import torch
from torch import nn

from src.metrics import timing
from src.metrics.lineup import Candidate, Subject
from src.metrics.pareto import knee
from src.metrics.scores import Scores
from src.models.cost import macs_per_frame
from src.models.export import OnnxNetwork, export
from src.models.fast import Fast, plain
from src.sim.pipeline import Pipeline, simulate

FORMS = ("float32", "bf16", "onnx")
PEAKS = {"float32": torch.float32, "bf16": torch.bfloat16, "onnx": torch.float32}
SEVERITIES = ("weak", "medium", "strong", "mixed")
FILLED = 0.05  # share of a grid's entries that are not zero, as in our streams


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
class Speed:
    """One network in one form on one size of picture; `limit_ms`, what the arithmetic alone takes.

    `reason`: why there is no time.
    """

    network: str
    trained: bool
    views: int
    side: int
    device: str
    threads: int
    form: str
    ms: float | None = None
    least_ms: float | None = None
    frames: int = 0
    clock: str = ""
    gmac: float | None = None
    params: int | None = None
    peak_mib: float | None = None
    energy_mj: float | None = None
    limit_ms: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class Score:
    """The scores of one network in one form on one clip."""

    network: str
    form: str
    severity: str
    clip: int
    values: Mapping[str, float]


class Stopwatch:
    """Times networks.  `seconds` for each entry; what would take more than `longest_s` a frame by
    arithmetic alone is left out and says so.  ONNX files go to `folder`.
    """

    def __init__(self, folder: Path, *, seconds: float, longest_s: float, bins: int):
        self.folder, self.seconds, self.longest_s = folder, seconds, longest_s
        self.bins = bins
        self.peaks: dict[tuple[str, int], float] = {}

    def peak(self, form: str, count: int) -> float:
        """Return the machine's multiply-accumulates a second, measured once."""
        if (form, count) not in self.peaks:
            self.peaks[form, count] = timing.convolution_peak(PEAKS[form], count=count)
        return self.peaks[form, count]

    def rows(
        self, candidate: Candidate, sides: Sequence[int], counts: Sequence[int],
        forms: Sequence[str], devices: Sequence[str],
    ) -> Iterable[Speed]:  # fmt: skip
        """Yield one entry for each combination; a GPU has no threads to choose and no ONNX."""
        for side in sides:
            for device in devices:
                for form in forms if device == "cpu" else [f for f in forms if f != "onnx"]:
                    for count in counts if device == "cpu" else [1]:
                        yield self._row(candidate, side, device, count, form)

    def _row(self, candidate: Candidate, side: int, device: str, count: int, form: str) -> Speed:
        known: dict[str, Any] = {
            "network": candidate.name, "trained": candidate.trained, "views": candidate.views,
            "side": side, "device": device, "threads": count, "form": form,
        }  # fmt: skip
        if candidate.network is None:
            return Speed(**known, reason=candidate.missing)
        network = candidate.network
        macs = macs_per_frame(network, side, side, views=candidate.views, bins=self.bins)
        known |= {
            "gmac": macs / 1e9,
            "params": sum(p.numel() for p in network.parameters()),
            "energy_mj": 1e3 * macs * timing.JOULE_PER_MAC,
        }
        if device == "cpu":
            known["limit_ms"] = 1e3 * macs / self.peak(form, count)
            if known["limit_ms"] > 1e3 * self.longest_s:
                reason = f"more than {self.longest_s:g} s a frame by arithmetic alone"
                return Speed(**known, reason=reason)
        try:
            return self._timed(candidate, known)
        except ValueError as error:
            return Speed(**known, reason=str(error))

    def _timed(self, candidate: Candidate, known: dict[str, Any]) -> Speed:
        side, form, device = known["side"], known["form"], known["device"]
        size = (1, candidate.views, self.bins, side, side)
        drawn = torch.Generator().manual_seed(0)
        voxels = torch.randn(size, generator=drawn)
        voxels = (voxels * (torch.rand(size, generator=drawn) < FILLED)).to(device)
        running = self._running(candidate, form, side, known["threads"]).to(device)
        if form != "onnx":
            known["peak_mib"] = timing.peak_bytes(running, voxels) / 2**20
        took = timing.frame(running, voxels, count=known["threads"], seconds=self.seconds)
        return Speed(
            **known, ms=took.median_ms, least_ms=took.least_ms, frames=took.frames, clock=took.clock
        )

    def _running(self, candidate: Candidate, form: str, side: int, count: int) -> nn.Module:
        if form == "float32":
            return plain(candidate.network)
        if form == "bf16":
            return rounded(candidate.network)
        path = self.folder / f"{candidate.name}_{side}.onnx"
        if not path.is_file():
            size = {"views": candidate.views, "height": side, "width": side, "bins": self.bins}
            export(candidate.network, path, **size)
        return OnnxNetwork(path, count)


def rounded(network: nn.Module) -> nn.Module:
    """Return `network` in bf16; ValueError where it has nothing to round."""
    if not any(True for _ in network.parameters()):
        raise ValueError("it has no parameters to round")
    return Fast(network, skip_empty=False)


def scores(
    candidates: Sequence[Candidate], pipelines: Mapping[str, Pipeline], clips: int,
    measure: Scores, *, warmup: int, forms: Sequence[str],
) -> list[Score]:  # fmt: skip
    """Return the scores of all trained networks on the same `clips` clips of every severity."""
    subjects = _subjects(candidates, forms)
    found = []
    for severity, pipeline in pipelines.items():
        for clip in range(clips):
            sample = simulate(pipeline, [clip])
            windows, seconds = sample.voxels[0, :, None], float(sample.window_s[0])
            truth = sample.target[0, warmup:]
            for form, subject in subjects:
                frames, _ = subject.play(windows, list(sample.positions), seconds)
                values = measure(frames[warmup:], truth)
                found.append(Score(subject.name, form, severity, clip, values))
        rich.print(f"scored on {severity} turbulence")
    return found


def _subjects(candidates: Sequence[Candidate], forms: Sequence[str]) -> list[tuple[str, Subject]]:
    found = []
    for candidate in candidates:
        if candidate.network is None or not candidate.trained:
            continue
        found.append(("float32", Subject(candidate.name, candidate.network, candidate.views)))
        if "bf16" in forms and any(True for _ in candidate.network.parameters()):
            half = rounded(candidate.network)
            found.append(("bf16", Subject(candidate.name, half, candidate.views)))
    return found


def knees(speeds: Sequence[Speed], found: Sequence[Score], side: int) -> dict[str, str]:
    """Return for each severity the cheapest network within one standard error of the best.

    By LPIPS, else by 1 - SSIM; the cost is thread time in ms on pictures of `side`, float32.
    """
    costs = {s.network: s.ms for s in speeds if s.ms and _named(s, side, "float32")}
    return {
        severity: knee(costs, _errors(found, severity, costs))
        for severity in dict.fromkeys(row.severity for row in found)
        if _errors(found, severity, costs)
    }


def _errors(found: Sequence[Score], severity: str, costs: Mapping) -> dict[str, list[float]]:
    errors: dict[str, list[float]] = {}
    for row in found:
        if (row.severity, row.form) == (severity, "float32") and row.network in costs:
            error = row.values.get("lpips", 1 - row.values["ssim"])
            errors.setdefault(row.network, []).append(error)
    return errors


def _named(s: Speed, side: int, form: str) -> bool:
    return (s.side, s.form, s.threads, s.device) == (side, form, 1, "cpu")


def words(
    speeds: Sequence[Speed], found: Sequence[Score], knees: Mapping[str, str], side: int
) -> str:
    """Return the knees and a table of the means over all clips, as Markdown."""
    metrics = list(found[0].values) if found else []
    lines = ["# Speed against accuracy\n"]
    lines += [f"- {severity} turbulence: take {name}." for severity, name in knees.items()]
    lines += [
        f"\nMean over all clips; ms a frame of {side}x{side}, computed by one CPU thread.  "
        "Without scores: no weights, timed only.\n",
        "| network | form | ms | GMAC | parameters | " + " | ".join(metrics) + " |",
        "|---|---|" + "---:|" * (3 + len(metrics)),
    ]
    for s in speeds:
        if s.threads == 1 and s.side == side and s.device == "cpu":
            rows = [r.values for r in found if (r.network, r.form) == (s.network, s.form)]
            means = [f"{sum(r[m] for r in rows) / len(rows):.3f}" if rows else "" for m in metrics]
            time = s.reason if s.ms is None else f"{s.ms:.2f}"
            size = [f"{s.gmac:.2f}" if s.gmac is not None else "", str(s.params or 0)]
            name = s.network + ("" if s.trained else " (no weights)")
            lines.append("| " + " | ".join([name, s.form, time, *size, *means]) + " |")
    return "\n".join(lines) + "\n"


def speed_csv(rows: Sequence[Speed]) -> str:
    """Return one line per entry."""
    return _csv([field.name for field in fields(Speed)], [_short(asdict(row)) for row in rows])


def scores_csv(rows: Sequence[Score]) -> str:
    """Return one line per network, form and clip."""
    lines = [
        {"network": r.network, "form": r.form, "severity": r.severity, "clip": r.clip} | r.values
        for r in rows
    ]
    return _csv(list(lines[0]) if lines else ["network"], [_short(line) for line in lines])


def _short(line: Mapping) -> dict:
    return {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in line.items()}


def _csv(heads: list[str], lines: list[dict]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, heads)
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()
