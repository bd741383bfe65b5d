"""Look at what the simulation makes: python -m src.simulate turbulence=strong sensor=noisy."""

from pathlib import Path

import hydra
import rich
from omegaconf import DictConfig

from src import build, door
from src.figures import samples
from src.metrics import results
from src.sim.pipeline import simulate as run_pipeline


def simulate(cfg: DictConfig) -> dict:
    """Simulate test clip `index` and write `views.png`, `views.gif` into `cfg.paths.run`.

    Returns what was drawn: D/r0, tilt and blur in pixels, threshold ...
    """
    run = Path(cfg.paths.run)
    pipeline = build.pipeline(cfg, "test")
    sample = run_pipeline(pipeline, [cfg.index])
    results.open_run(run, door.resolved(cfg))
    samples.write_views(run, sample, pipeline.optics)
    rich.print(sample.drawn[0], f"in {run}")
    return sample.drawn[0]


@hydra.main(version_base=None, config_path="../conf", config_name="simulate")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `simulate`."""
    door.job(simulate, cfg)


if __name__ == "__main__":
    door.run(main)
