"""Train a network on simulated light fields and test it: python -m src.train experiment=lf3x3."""

import sys
import time
from pathlib import Path

import hydra
import lightning
import torch
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from src.app import build, door
from src.figures import samples
from src.models import files
from src.records import results, tracking
from src.training import handover
from src.training.guard import NotFinite


def train(cfg: DictConfig) -> dict:
    """Fit, test beside the untrained network and the high-pass baseline, write `results.json`.

    Everything goes below `cfg.paths.run`.  Returns the content of `results.json`; of several
    processes that train together all but the first train only, and return {}.
    """
    run, start = Path(cfg.paths.run), time.perf_counter()
    build.share_cores(cfg)
    build.keep_memory(cfg)
    build.choose_precision(cfg)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    net, spec = build.network(cfg)
    start_from = files.require(cfg.ckpt, spec) if cfg.ckpt else None
    module, data = build.reconstructor(cfg, net, spec), build.data(cfg)
    trainer = build.trainer(cfg)
    if rank_zero_only.rank:
        fit(trainer, module, data, start_from)
        return {}
    results.open_run(run, door.resolved(cfg))
    untrained = build.test(cfg, "untrained", module.method, data, module.scores)
    tracking.begin(trainer.loggers, OmegaConf.to_container(cfg, resolve=True))
    try:
        fit(trainer, module, data, start_from)
    except NotFinite as error:
        same = f"python -m src.simulate like={run}/config.yaml split=train index={error.clips[0]}"
        raise ValueError(f"{error}; seed {cfg.seed}; to see the clip: {same}") from error
    module.method.to(memory_format=torch.contiguous_format)  # as it is when it is loaded again
    trained = build.test(cfg, cfg.name, module.method, data, module.scores)
    least = build.part(cfg, "floor.method")
    floor = build.test(cfg, cfg.floor.name, least, data, module.scores)
    pictures = samples.write(run / "samples", module.method, data.pipelines["test"])
    rows, facts = [trained, untrained, floor], door.facts(cfg, start)
    record = results.write(run, door.resolved(cfg), rows, **facts)
    tracking.end(trainer.loggers, record, pictures)
    return record


def fit(trainer: lightning.Trainer, module, data, start_from: Path | None) -> None:
    """Train; when that is cut short, whatever by, say what to go on from."""
    last = Path(trainer.checkpoint_callback.dirpath) / "last.ckpt"
    if start_from and files.exported(start_from):
        handover.take(module, trainer.callbacks, start_from)
        start_from = None
    try:
        trainer.fit(module, data, ckpt_path=start_from)
        if not last.is_file():  # nothing was left to do
            trainer.save_checkpoint(last)
    except BaseException:
        if any(last.parent.glob("*.ckpt")):
            step = trainer.global_step
            print(f"stopped at step {step}; go on with ckpt={last.parent}", file=sys.stderr)
        raise


@hydra.main(version_base=None, config_path="../conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `train`."""
    door.job(train, cfg)


if __name__ == "__main__":
    door.run(main)
