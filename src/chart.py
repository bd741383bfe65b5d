"""Speed against accuracy, one figure: python -m src.chart."""

from pathlib import Path

import hydra
import rich
from omegaconf import DictConfig

from src.app import build, door, lineup
from src.bench import charting
from src.bench.speed import Stopwatch
from src.figures import changing_air, frontier
from src.records import results


def chart(cfg: DictConfig) -> dict:
    """Time and score every network; write figures, `speed.csv`, `scores.csv` and `chart.md`.

    Returns {severity: name of the knee}.  Raises ValueError for networks, sizes, forms or
    severities that are no such thing.
    """
    run = Path(cfg.paths.run)
    charting.check(cfg.sizes, cfg.threads, cfg.forms, cfg.devices, cfg.severities, cfg.clips)
    adaptive = lineup.adaptive(cfg) if cfg.adapt else None
    candidates = lineup.gather(cfg)
    results.open_run(run, door.resolved(cfg))
    limits = {"longest_s": cfg.longest_s, "bins": cfg.bins, "onnx_side": cfg.onnx_side}
    watch = Stopwatch(run, seconds=cfg.seconds, **limits)
    what = (cfg.sizes, cfg.threads, cfg.forms, cfg.devices)
    speeds = [row for candidate in candidates for row in watch.rows(candidate, *what)]
    results.write_text(run / "speed.csv", charting.speed_csv(speeds))
    pipelines = {severity: lineup.under(cfg, severity) for severity in cfg.severities}
    options = {"warmup": cfg.data.warmup, "forms": cfg.forms}
    scores = charting.scores(candidates, pipelines, cfg.clips, build.scores(cfg), **options)
    results.write_text(run / "scores.csv", charting.scores_csv(scores))
    knees = charting.knees(speeds, scores, cfg.sizes[0])
    text = charting.words(speeds, scores, knees, cfg.sizes[0])
    for suffix in ("png", "svg"):
        title = "mean over " + ", ".join(cfg.severities) + " turbulence"
        path = run / f"chart.{suffix}"
        frontier.accuracy(path, speeds, scores, side=cfg.sizes[0], title=title)
        frontier.machine(run / f"machine.{suffix}", speeds, watch.peaks)
    if adaptive is not None:
        text += changing_air.write(run, adaptive, cfg.adapt.course, cfg.adapt.clips)
    results.write_text(run / "chart.md", text)
    rich.print(text, f"in {run}")
    return knees


@hydra.main(version_base=None, config_path="../conf", config_name="chart")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `chart`."""
    door.job(chart, cfg)


if __name__ == "__main__":
    door.run(main)
