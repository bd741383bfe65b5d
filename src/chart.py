"""Speed against accuracy, one figure: python -m src.chart."""

from pathlib import Path

import hydra
import rich
from omegaconf import DictConfig, OmegaConf

from src import build, door, lineup
from src.figures import frontier
from src.metrics import charting, results


def chart(cfg: DictConfig) -> dict:
    """Time and score every network; write figures, `speed.csv`, `scores.csv` and `chart.md`.

    Returns {severity: name of the knee}.  Raises ValueError for networks, sizes, forms or
    severities that are no such thing.
    """
    run = Path(cfg.paths.run)
    check(cfg)
    candidates = lineup.gather(cfg)
    results.open_run(run, door.resolved(cfg))
    watch = charting.Stopwatch(run, seconds=cfg.seconds, longest_s=cfg.longest_s, bins=cfg.bins)
    what = (cfg.sizes, cfg.threads, cfg.forms, cfg.devices)
    speeds = [row for candidate in candidates for row in watch.rows(candidate, *what)]
    results.write_text(run / "speed.csv", charting.speed_csv(speeds))
    pipelines = {severity: pipeline(cfg, severity) for severity in cfg.severities}
    options = {"warmup": cfg.data.warmup, "forms": cfg.forms}
    scores = charting.scores(candidates, pipelines, cfg.clips, build.scores(cfg), **options)
    results.write_text(run / "scores.csv", charting.scores_csv(scores))
    knees = charting.knees(speeds, scores, cfg.sizes[0])
    text = charting.words(speeds, scores, knees, cfg.sizes[0])
    results.write_text(run / "chart.md", text)
    for suffix in ("png", "svg"):
        title = "mean over " + ", ".join(cfg.severities) + " turbulence"
        path = run / f"chart.{suffix}"
        frontier.accuracy(path, speeds, scores, side=cfg.sizes[0], title=title)
        frontier.machine(run / f"machine.{suffix}", speeds, watch.peaks)
    rich.print(text, f"in {run}")
    return knees


def pipeline(cfg: DictConfig, severity: str):
    """Return the simulation of test clips under `severity`."""
    changed = OmegaConf.merge(cfg, {"turbulence": {"atmosphere": {"severity": severity}}})
    return build.pipeline(changed, "test")


def check(cfg: DictConfig) -> None:
    """Raise ValueError unless sizes, threads and forms can be measured."""
    if not cfg.sizes or min(cfg.sizes) < 16 or any(side % 8 for side in cfg.sizes):
        raise ValueError(f"sizes must be multiples of 8 from 16 on, got {list(cfg.sizes)}")
    if not cfg.threads or min(cfg.threads) < 1:
        raise ValueError(f"threads must be numbers >= 1, got {list(cfg.threads)}")
    if not cfg.forms or set(cfg.forms) - set(charting.FORMS):
        allowed = ", ".join(charting.FORMS)
        raise ValueError(f"forms must be of {allowed}, got {list(cfg.forms)}")
    if not cfg.severities or cfg.clips < 1:
        raise ValueError(f"severities and clips must be given, got {cfg.severities}, {cfg.clips}")
    if set(cfg.devices) - {"cpu", "cuda"}:
        raise ValueError(f"devices must be of cpu, cuda, got {list(cfg.devices)}")


@hydra.main(version_base=None, config_path="../conf", config_name="chart")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `chart`."""
    door.job(chart, cfg)


if __name__ == "__main__":
    door.run(main)
