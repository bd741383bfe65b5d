"""Speed against accuracy, one figure: python -m src.chart."""

from pathlib import Path

import rich
from omegaconf import DictConfig

from src.app import compared_networks, entry_point, simulation
from src.app.metrics import build_metrics
from src.bench import speed_accuracy
from src.bench.speed import SpeedBenchmark
from src.figures import frontier
from src.records import results
from src.records.atomic import write_text


def draw_speed_accuracy_chart(cfg: DictConfig) -> dict[str, str]:
    """Time and score networks; write `chart.png`, `chart.svg`, `chart.md` and two tables (`*.csv`).

    Returns {severity: the cheapest network within one standard error of the best}.  Raises
    ValueError for networks, sizes, forms or severities that are none.
    """
    run, side = Path(cfg.paths.run), cfg.sizes[0] if cfg.sizes else 0
    measured = (cfg.sizes, cfg.threads, cfg.forms, cfg.devices)
    speed_accuracy.check_chart_options(*measured, cfg.severities, cfg.clips, cfg.seconds)
    simulation.check_unscored_windows(cfg)
    candidates = compared_networks.load_candidates(cfg)
    pipelines = {name: compared_networks.pipeline_at_severity(cfg, name) for name in cfg.severities}
    metrics, warmup = build_metrics(cfg), cfg.data.unscored_windows
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    benchmark = SpeedBenchmark(run, seconds=cfg.seconds, bins=cfg.bins)
    speeds = [row for candidate in candidates for row in benchmark.measure(candidate, *measured)]
    write_text(run / "speed.csv", speed_accuracy.format_speeds_csv(speeds))
    scores = speed_accuracy.score_accuracy(candidates, pipelines, cfg.clips, metrics, warmup=warmup)
    write_text(run / "scores.csv", speed_accuracy.format_scores_csv(scores))
    recommended = speed_accuracy.recommend_network_per_severity(speeds, scores, side)
    text = speed_accuracy.format_chart_summary(speeds, scores, recommended, side)
    title = "mean over " + ", ".join(cfg.severities) + " turbulence"
    for suffix in ("png", "svg"):
        path = run / f"chart.{suffix}"
        frontier.draw_accuracy_against_time(path, speeds, scores, side=side, title=title)
    write_text(run / "chart.md", text)
    rich.print(text)
    print(f"in {run}")
    return recommended


if __name__ == "__main__":
    entry_point.run_command(draw_speed_accuracy_chart, "chart")
