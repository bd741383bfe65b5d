"""Train a network on simulated light fields and test it: python -m src.train experiment=lf3x3."""

import time
from pathlib import Path

import hydra
import lightning
from omegaconf import DictConfig

from src import build, door
from src.figures import samples
from src.metrics import results
from src.models import files


def train(cfg: DictConfig) -> dict:
    """Fit, test beside the untrained network and the high-pass baseline, write `results.json`.

    Everything goes below `cfg.paths.run`.  Returns the content of `results.json`.
    """
    run, start = Path(cfg.paths.run), time.perf_counter()
    build.share_cores(cfg)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    net, spec = build.network(cfg)
    if cfg.ckpt:
        files.require(cfg.ckpt, spec)
    module, data = build.reconstructor(cfg, net, spec), build.data(cfg)
    results.open_run(run, door.resolved(cfg))
    untrained = build.test(cfg, "untrained", net, data, module.scores)
    build.trainer(cfg).fit(module, data, ckpt_path=cfg.ckpt)
    trained = build.test(cfg, cfg.name, net, data, module.scores)
    floor = build.test(cfg, "high-pass, centre view", build.make(cfg.floor), data, module.scores)
    samples.write(run / "samples", net, data.pipelines["test"])
    return results.write(
        run, door.resolved(cfg), [trained, untrained, floor], **door.facts(cfg, start)
    )


@hydra.main(version_base=None, config_path="../conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `train`."""
    door.job(train, cfg)


if __name__ == "__main__":
    door.run(main)
