"""Test a trained network or a baseline: python -m src.eval ckpt=lf3x3 turbulence=strong."""

import time
from pathlib import Path

import hydra
from omegaconf import DictConfig

from src.app import build, door, simulation
from src.figures import samples
from src.records import results


def evaluate(cfg: DictConfig) -> dict:
    """Score the network of `ckpt` or `baseline` on the test clips, write `results.json`.

    Everything goes below `cfg.paths.run`.  Returns the content of `results.json`.
    """
    run, start = Path(cfg.paths.run), time.perf_counter()
    build.share_cores(cfg)
    net = build.frozen(cfg)
    data = build.data(cfg, splits=("test",), optics=simulation.light_field(cfg, net))
    results.open_run(run, door.resolved(cfg))
    row = build.test(cfg, cfg.name, net, data, build.scores(cfg))
    samples.write(run / "samples", net, data.pipelines["test"])
    return results.write(run, door.resolved(cfg), [row], **door.facts(cfg, start))


@hydra.main(version_base=None, config_path="../conf", config_name="eval")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `evaluate`."""
    door.job(evaluate, cfg)


if __name__ == "__main__":
    door.run(main)
