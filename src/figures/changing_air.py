"""The adaptive network on air that rises and falls, against its first and its last level alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure

from src.bench.probes.clips import Conditions, Stream, film
from src.figures.plots import save
from src.metrics.image import aligned_psnr
from src.models.adaptive import Adaptive
from src.models.stopwatch import clock, threads
from src.records import results
from src.sim.pipeline import Pipeline

WARMUP = 10  # first windows that do not count
LINES = {"adaptive": "#d1571b", "always the least": "#5aa9e6", "always the most": "#1f5fa8"}


@dataclass(frozen=True)
class Shown:
    """What one way of running did in every window."""

    ms: Float[np.ndarray, " windows"]
    psnr: Float[np.ndarray, " windows"]
    level: Float[np.ndarray, " windows"]
    disagreement: Float[np.ndarray, " windows"]


def write(
    run: Path, adaptive: tuple[Adaptive, Pipeline] | str, course: Sequence[float], clips: int
) -> str:
    """Write `adapt.csv` of the first `clips`, and PNG and SVG of the first one, to `run`; return
    what they say.  A reason is returned.
    """
    if isinstance(adaptive, str):
        return f"\nThe adaptive network is not shown: {adaptive}\n"
    network, pipeline = adaptive
    conditions = Conditions(course=tuple(course))
    streams = [film(pipeline, clip, conditions) for clip in range(clips)]
    runs = [ways(network, stream) for stream in streams]
    results.write_text(run / "adapt.csv", table(runs))
    names = [f"{level.name}, {level.views}" for level in network.levels]
    for suffix in ("png", "svg"):
        draw(run / f"adapt.{suffix}", runs[0], names, network.bounds, course, streams[0].fps)
    return words(runs)


def ways(network: Adaptive, stream: Stream) -> dict[str, Shown]:
    """Return what each way of running did on a clip."""
    return {
        "adaptive": follow(network, stream),
        "always the least": follow(network, stream, only=0),
        "always the most": follow(network, stream, only=len(network.levels) - 1),
    }


@torch.no_grad()
def follow(network: Adaptive, stream: Stream, only: int | None = None) -> Shown:
    """Run window by window in thread time; `only`: this level throughout, and no comparing."""
    state, rows, places, now = None, [], list(stream.positions), clock(1)
    with threads(1):
        for k, voxels in enumerate(stream.windows(stream.fps)):
            start, window_s = now(), 1 / stream.fps
            if only is None:
                frame, state = network(voxels, state, window_s=window_s, positions=places)
                at, apart = state.level, state.disagreement
            else:
                frame, state = network.run(voxels, only, state, places, window_s=window_s)
                at, apart = only, np.nan
            ms = 1e3 * (now() - start)
            score = aligned_psnr(frame.float().clamp(0, 1), stream.target[k + 1][None, None])
            rows.append((ms, float(score[0]), float(at), apart))
    return Shown(*np.array(rows, dtype=float).T)


def table(runs: list[dict[str, Shown]]) -> str:
    """Return CSV, one line for each clip, way of running and window."""
    heads, lines = ("clip", "run", "window", "ms", "aligned_psnr_db", "level", "disagreement"), []
    for clip, shown in enumerate(runs):
        for name, s in shown.items():
            rows = zip(s.ms, s.psnr, s.level, s.disagreement, strict=True)
            lines += [[clip, name, k, *(f"{v:.5g}" for v in row)] for k, row in enumerate(rows)]
    return results.csv_text(heads, lines)


def words(runs: list[dict[str, Shown]]) -> str:
    """Return what was spent and what was lost, clip by clip."""
    heads = "| run | ms a window | aligned PSNR, dB | clip by clip |"
    lines = ["\n## As much as the air asks for\n", heads, "|---|---:|---:|---|"]
    for name in runs[0]:
        ms = np.mean([shown[name].ms[WARMUP:].mean() for shown in runs])
        scores = [shown[name].psnr[WARMUP:].mean() for shown in runs]
        each = ", ".join(f"{score:.2f}" for score in scores)
        lines.append(f"| {name} | {ms:.2f} | {np.mean(scores):.2f} | {each} |")
    return "\n".join(lines) + "\n"


def draw(
    path: Path, shown: dict[str, Shown], names: list[str], bounds: list[float],
    course: Sequence[float], fps: float,
) -> Path:  # fmt: skip
    """Draw, over time: strength of the air, disagreement, level, milliseconds, aligned PSNR."""
    figure = Figure(figsize=(8.5, 8), layout="constrained")
    air, apart, level, cost, quality = figure.subplots(5, 1, sharex=True)
    windows = len(shown["adaptive"].ms)
    t = np.arange(1, windows + 1) / fps
    air.stairs(course, np.linspace(0, windows / fps, len(course) + 1), color="0.3", lw=1.5)
    apart.plot(t, shown["adaptive"].disagreement, color=LINES["adaptive"], lw=1.3)
    for bound in bounds:
        apart.axhline(bound, color="0.6", lw=0.8, ls=":")
    level.step(t, shown["adaptive"].level, where="mid", color=LINES["adaptive"], lw=1.5)
    level.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    level.set_ylim(-0.3, len(names) - 0.7)
    for name, s in shown.items():
        cost.plot(t, _smooth(s.ms), color=LINES[name], lw=1.3, label=name)
        quality.plot(t, _smooth(s.psnr), color=LINES[name], lw=1.3)
    heads = ("D/r0", "disagreement", "network, views", "ms a window", "aligned PSNR, dB")
    for axes, head in zip((air, apart, level, cost, quality), heads, strict=True):
        axes.set_ylabel(head, fontsize=9)
        axes.grid(alpha=0.25)
    cost.set_ylim(bottom=0)
    figure.legend(*cost.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    quality.set_xlabel("seconds")
    figure.align_ylabels()
    return save(figure, path)


def _smooth(values: Float[np.ndarray, " windows"]) -> Float[np.ndarray, " windows"]:
    """Return the median over nine windows: single late windows say nothing."""
    padded = np.pad(values, 4, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 9), axis=1)
