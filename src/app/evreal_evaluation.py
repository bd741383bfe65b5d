"""Recordings with frames, scored by the protocol of EVREAL: `src.eval data=evreal`."""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Group
from rich.table import Table

from baselines import published
from baselines.centre_view import CentreViewNetwork
from src.app import entry_point, methods
from src.app.config_files import CONF
from src.app.hardware import first_requested_gpu
from src.app.instantiate import as_dict, build_part
from src.app.metrics import SHIPPED_METRIC_KEYS
from src.metrics.table import Column
from src.models import files
from src.models.network import EventToVideoNetwork
from src.recordings.event_windows import check_time_range
from src.recordings.evreal_protocol import (
    EvrealRule,
    ScoredFrame,
    check_scored_range,
    score_sequence,
)
from src.recordings.evreal_sequences import find_sequences, open_as_evreal, sequence_name
from src.recordings.files.evreal_folder import is_evreal_folder, open_sequence
from src.recordings.output import write_png
from src.recordings.reconstruction import require_event_network
from src.records import results
from src.records.atomic import write_text
from src.training import evaluation

MSE = Column("mse", "MSE", 3, -1)
SCORES = {"mse": MSE.title, "ssim": "SSIM ↑", "lpips": "LPIPS ↓"}
RULE_KEYS = (
    "window", "events_per_window", "window_s", "max_grid_s", "histogram", "tolerance_ms",
    "warm_up_s",
)  # fmt: skip
PROTOCOL_KEYS = ("window", "max_grid_s", "histogram", "warm_up_s", "start_s", "end_s")


def evaluate_on_evreal(cfg: DictConfig) -> dict:
    """Score the network of `ckpt` or `baseline` on the sequences below `cfg.scene.root`.

    Writes `results.json`, `clips.csv` (a line per sequence) and `frames.csv` below
    `cfg.paths.run`.  Returns the content of `results.json`.
    """
    run, start = Path(cfg.paths.run), time.perf_counter()
    benchmark = EvrealBenchmark(cfg)
    sources = find_sequences(cfg.scene.root)
    for folder in filter(is_evreal_folder, sources):  # what is wrong is said before hours of work
        _, first_s, last_s = find_scored_range(cfg.data, folder)
        check_scored_range(open_sequence(folder), benchmark.rule.window, first_s, last_s)
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    clips, lines = [], []
    for source in sources:
        clip, scored = benchmark.score_sequence(source, run)
        clips.append(clip)
        lines += scored
        shown = ", ".join(f"{s.upper()} {clip[s]:.4f}" for s in SCORES if s in clip)
        print(f"{clip['name']}: {clip['frames']} frames{_describe_left_out(clip)}, {shown}")
    write_text(run / "frames.csv", results.format_csv(lines[0], [line.values() for line in lines]))
    means, row = average_by_data_set(clips), benchmark.build_score_row(clips)
    return results.write_and_print_results(
        run, entry_point.resolved_yaml(cfg), [row], _tables(row.name, means, cfg.data),
        describe_other_protocol(cfg.data, means), benchmarks=means,
        **entry_point.run_metadata(cfg, start),
    )  # fmt: skip


class EvrealBenchmark:
    """The network of a config and how it is scored on a sequence."""

    def __init__(self, cfg: DictConfig):
        self.cfg, self.rule = cfg, _build_rule(cfg)
        on_gpu = cfg.trainer.accelerator == "gpu"
        self.device = f"cuda:{first_requested_gpu(cfg)}" if on_gpu else "cpu"
        self.network = _load_network(cfg).to(self.device)
        if self.rule.output_normalisation != "none" and isinstance(self.network, CentreViewNetwork):
            self.network.output = self.network.output.replace("clip", "none")  # clipped after it
        lpips = build_part(cfg, "metrics.lpips") if cfg.metrics.lpips else None
        self.lpips, self.size = lpips and lpips.to(self.device), (0, 0)

    def score_sequence(self, source: Path, run: Path) -> tuple[dict, list[dict]]:
        """Return the mean scores of a sequence, and a line of each frame's."""
        data_set, first_s, last_s = find_scored_range(self.cfg.data, source)
        name, lines = f"{data_set}/{sequence_name(source)}", []
        with open_as_evreal(source, run) as sequence:
            check_scored_range(sequence, self.rule.window, first_s, last_s)
            self.size = sequence.size
            for frame in score_sequence(
                sequence, self.network, self.rule, bins=self.cfg.bins, start_s=first_s,
                end_s=last_s, lpips=self.lpips, device=self.device,
            ):  # fmt: skip
                lines.append({"sequence": name, **_line(frame)})
                if self.cfg.data.save_frames:
                    _save(run / "frames" / name, frame)
        if not lines:
            raise ValueError(f"{source}: no window ends within data.tolerance_ms of a frame")
        times = [line["time_s"] for line in lines]
        facts = {"name": name, "data_set": data_set, "first_s": min(times), "last_s": max(times)}
        return facts | average_frames(lines), lines

    def build_score_row(self, clips: list[dict]) -> results.ScoreRow:
        """Return the scores with the network's cost for frames of the last sequence's size."""
        (height, width), bins = self.size, self.cfg.bins
        window = torch.zeros(1, 1, bins, height, width, device=self.device)
        macs, milliseconds = evaluation.measure_frame_macs_and_ms(self.network, window)
        return results.ScoreRow(
            methods.method_name(self.cfg),
            clips,
            params=sum(part.numel() for part in self.network.parameters()),
            macs_per_frame=macs,
            latency_ms_by_size={f"{height}x{width}": milliseconds},
            own_metrics=(MSE,),
        )


def _load_network(cfg: DictConfig) -> EventToVideoNetwork:
    if cfg.get("postprocess") or cfg.get("backward_warmup_s"):
        raise ValueError("data=evreal needs postprocess=none and backward_warmup_s=0.0")
    if own := sorted(set(cfg.metrics) - set(SHIPPED_METRIC_KEYS)):
        raise ValueError(f"data=evreal has the metrics of its protocol only, got metrics.{own[0]}")
    network = require_event_network(methods.load_ckpt_or_baseline(cfg))
    if network.views not in (None, 1):
        raise ValueError(f"ckpt must take one view for data=evreal, got one of {network.views}")
    return network.eval()


def _build_rule(cfg: DictConfig) -> EvrealRule:
    """Return the protocol; what is null there follows from the method, as in EVREAL."""
    data = cfg.data
    baseline = cfg.get("baseline") or {}
    ours = Path(files.locate(baseline.get("weights") or "")).suffix in published.OURS
    edges = data.grid_edges or ("events" if baseline and not ours else "window")
    kind = baseline.get("architecture")
    output = data.output_normalisation or ("robust" if kind == "e2vid" else "none")
    given = {key: data[key] for key in RULE_KEYS}
    return EvrealRule(**given, grid_edges=edges, output_normalisation=output)


def find_scored_range(data: DictConfig, source: Path) -> tuple[str, float, float]:
    """Return the data set of a sequence and the first and last second to be scored.

    Raises ValueError for a range that is none.
    """
    name, folder = sequence_name(source), source.resolve().parent.name
    known = [(group, spans[name]) for group, spans in data.sequences.items() if name in spans]
    data_set, span = known[0] if known else ("other" if folder in data.sequences else folder, None)
    first, last = span or (0.0, math.inf)
    first = first if data.start_s is None else data.start_s
    last = last if data.end_s is None else data.end_s
    check_time_range(first, last, "data.")
    return data_set, float(first), float(last)


def _line(frame: ScoredFrame) -> dict:
    window = frame.evreal_window
    facts = {"window": frame.window_index, "frame": window.nearest_camera_frame}
    times = {"time_s": round(window.time_s, 6)}
    return facts | times | {"events": window.stop_event - window.first_event} | frame.scores


def average_frames(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return {frames, left_out, mse, ssim, lpips}: the means of the frames all of whose scores are
    finite, their number and that of the others, which EVREAL leaves out, too.  Where no frame has
    finite scores all count, and the means are NaN."""
    scores = [score for score in SCORES if score in lines[0]]
    finite = [line for line in lines if all(math.isfinite(line[score]) for score in scores)]
    kept = finite or lines
    means = {s: float(np.mean([line[s] for line in finite])) if finite else math.nan
             for s in scores}  # fmt: skip
    return {"frames": len(kept), "left_out": len(lines) - len(kept)} | means


def _describe_left_out(found: Mapping[str, Any]) -> str:
    return f" ({found['left_out']} without finite scores left out)" if found["left_out"] else ""


def average_by_data_set(clips: Sequence[Mapping[str, Any]]) -> dict[str, dict]:
    """Return {data set: {sequences, frames, left_out, mse, ssim, lpips}}; a sequence counts by its
    frames."""
    means = {}
    for data_set in dict.fromkeys(clip["data_set"] for clip in clips):
        group = [clip for clip in clips if clip["data_set"] == data_set]
        weights = [clip["frames"] for clip in group]
        counts = {"sequences": len(group), "frames": sum(weights)}
        counts["left_out"] = sum(clip["left_out"] for clip in group)
        means[data_set] = counts | {
            name: float(np.average([clip[name] for clip in group], weights=weights))
            for name in SCORES if name in group[0]
        }  # fmt: skip
    return means


def find_protocol_changes(data: DictConfig, data_set: str) -> list[str]:
    """Return the keys in which a run differs from the protocol of the published scores of a data
    set: its windows, their equalisation, its range."""
    protocol = OmegaConf.load(Path(CONF) / "data" / "evreal.yaml").data
    keys = [*PROTOCOL_KEYS, f"sequences.{data_set}"]
    return [key for key in keys if OmegaConf.select(data, key) != OmegaConf.select(protocol, key)]


def describe_other_protocol(data: DictConfig, data_sets: Iterable[str]) -> str:
    """Return a line that says why published scores are left out, "" where they are not."""
    published = {name for entry in data.published_scores for name in entry}
    changes = {key: None for name in data_sets if name in published
               for key in find_protocol_changes(data, name)}  # fmt: skip
    named = ", ".join(f"data.{key}" for key in changes)
    return f"published scores left out: not by their protocol ({named})" if named else ""


def _save(folder: Path, frame: ScoredFrame) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    levels = np.rint(frame.picture * 255).astype(np.uint8)
    write_png(folder / f"frame_{frame.window_index:010d}.png", levels)


def _tables(name: str, means: Mapping[str, Mapping], data: DictConfig) -> Group:
    """Return a table for each data set: the scores of this run and, where it is by their protocol,
    what others published."""
    tables = []
    for data_set, found in means.items():
        of = f" of {len(data.sequences[data_set])}" if data_set in data.sequences else ""
        counts = f"{found['sequences']}{of} sequences, {found['frames']} frames"
        counts += _describe_left_out(found)
        table = Table(title=f"{data_set}: {counts}", title_justify="left")
        for head in ("network", *SCORES.values(), "source"):
            table.add_column(head, justify="left" if head in ("network", "source") else "right")
        table.add_row(name, *(f"{found[k]:.3f}" if k in found else "-" for k in SCORES), "this run")
        is_by_protocol = not find_protocol_changes(data, data_set)
        for entry in map(as_dict, data.published_scores):
            if data_set in entry and is_by_protocol:
                theirs = [f"{value:.3f}" for value in entry[data_set]]
                table.add_row(entry["method"], *theirs, entry["source"])
        tables.append(table)
    return Group(*tables)
