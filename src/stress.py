"""Where methods fail: python -m src.stress, or python -m src.stress ckpt=[lf3x3,setnet_small]."""

from pathlib import Path

import hydra
import rich
from omegaconf import DictConfig

from src import build, door, lineup
from src.figures.heatmap import stress_map
from src.metrics import results
from src.probes import suite
from src.probes.bench import Bench


def stress(cfg: DictConfig) -> suite.Found:
    """Put every network through every probe; write the map, `stress.csv` and `stress.md`.

    Returns the findings, probe by probe and network by network.  Raises ValueError for networks or
    probes that are no such thing.
    """
    run = Path(cfg.paths.run)
    build.share_cores(cfg)
    candidates = lineup.gather(cfg)
    probes = {name: build.make(node.probe) for name, node in cfg.probes.items()}
    titles = {name: str(node.title) for name, node in cfg.probes.items()}
    results.open_run(run, door.resolved(cfg))
    bench = Bench(build.pipeline(cfg, "test"), range(cfg.clips), cfg.data.warmup)

    def keep(found: suite.Found) -> None:
        results.write_text(run / "stress.csv", suite.table(found, titles))

    found = suite.run(candidates, probes, bench, keep)
    standards = suite.standards(candidates, bench)
    text = suite.words(found, titles, standards)
    results.write_text(run / "stress.md", text)
    for suffix in ("png", "svg"):
        stress_map(run / f"stress.{suffix}", found, titles, standards)
    rich.print(text, f"in {run}")
    return found


@hydra.main(version_base=None, config_path="../conf", config_name="stress")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `stress`."""
    door.job(stress, cfg)


if __name__ == "__main__":
    door.run(main)
