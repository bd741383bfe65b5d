"""From a configuration to objects: the one place below the doors that sees a config.

`hydra.utils.instantiate` is called here only, so that what a config may name is decided here.
"""

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import lightning
import torch
from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from torch import nn

import src.models
from baselines import widened
from baselines.postprocess import Restoration
from baselines.upstream import from_config
from src.metrics.scores import Scores
from src.models.unroll import takes
from src.sim.optics import Optics, layout
from src.sim.pipeline import Pipeline
from src.sim.scenes.photographs import MixedRates
from src.sim.turbulence.model import TurbulenceModel
from src.training import evaluation
from src.training.bank import Bank, listing
from src.training.banked import Banked
from src.training.clock import Clock
from src.training.datamodule import LightFieldData
from src.training.filling import Filler
from src.training.reconstructor import Reconstructor

SIMULATED = "src.sim.turbulence.simulated.SimulatedAir"
CLIP = ("scene", "turbulence")  # sections that make a clip, whatever sees it
ROOMS = (
    "src.", "baselines.", "torch.optim.", "lightning.pytorch.trainer.",
    *(f"lightning.pytorch.{room}." for room in ("callbacks", "loggers", "plugins", "profilers")),
)  # fmt: skip


def make(node: Any, **kwargs) -> Any:
    """Instantiate a config node; raises ValueError for a `_target_`, however deep, that is no class
    of our rooms.

    A ValueError of the object itself comes through as it is, not wrapped by Hydra.
    """
    plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    if not isinstance(plain, dict) or "_target_" not in plain:
        raise ValueError(f"a part of the config must name its class (_target_), got {plain}")
    for target in _targets(plain):
        _check(target)
    try:
        return instantiate(node, _convert_="all", **kwargs)
    except InstantiationException as error:
        if isinstance(error.__cause__, ValueError):
            raise error.__cause__ from None
        raise ValueError(f"{plain['_target_']} takes no such values: {error.__cause__}") from error


def _targets(node: Any) -> Iterator[str]:
    """Yield every `_target_` in plain dicts and lists."""
    if isinstance(node, dict):
        yield from (str(value) for key, value in node.items() if key == "_target_")
    if isinstance(node, dict | list):
        for value in node.values() if isinstance(node, dict) else node:
            yield from _targets(value)


def _check(target: str) -> None:
    """Raise ValueError unless `target` is a class that was written in one of the rooms.

    A name alone says little: `torch.optim.adam.torch.load` begins like an optimiser.
    """
    if not target.startswith(("src.", "baselines.", "torch.optim.", "lightning.")):
        raise ValueError(f"_target_ must be a class of {', '.join(ROOMS)}, got {target}")
    try:
        found = get_object(target)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"_target_ must name a class, got {target}") from error
    home = f"{getattr(found, '__module__', '')}."
    if found is not from_config and not (isinstance(found, type) and home.startswith(ROOMS)):
        raise ValueError(f"_target_ must be a class of {', '.join(ROOMS)}, got {target}")


def pipeline(cfg: DictConfig, split: str) -> Pipeline:
    """Return the simulation of one split: train, val or test."""
    training = split == "train"
    if training and cfg.data.get("bank") is not None:
        return Banked(
            bank(cfg),
            make(cfg.optics),
            OmegaConf.to_container(cfg.sensor, resolve=True),
            windows=_count(cfg, "data.windows"),
            bins=cfg.bins,
            crop=cfg.data.crop,
            independent=cfg.turbulence.get("views_correlation", "independent") == "independent",
        )
    return _simulation(
        cfg,
        split,
        windows=_count(cfg, "data.windows" if training else "data.test_windows"),
        optics=make(cfg.optics),
        sensor=OmegaConf.to_container(cfg.sensor, resolve=True),
        crop=cfg.data.crop if training else cfg.data.test_crop,
        clips=cfg.data.clips if training else None,
    )


def bank(cfg: DictConfig) -> Bank:
    """Return the bank of air that `data.bank` asks for, named by all that makes its clips.

    Nine views or fewer come out of one bank: view i depends on the draws of view i only.
    """
    optics, side = make(cfg.optics), _count(cfg, "data.bank_crop")
    if set(optics.positions) <= set(layout(9)):
        optics = replace(optics, views=9, positions=layout(9))
    light = {"input": cfg.sensor.input}
    windows, substeps = _count(cfg, "data.bank_windows"), _count(cfg, "data.substeps")
    source = _simulation(
        cfg, "train", windows=windows, optics=optics, sensor=light, crop=side, clips=None
    )
    parts = {name: OmegaConf.to_container(cfg[name], resolve=True) for name in CLIP}
    made_of = parts | {
        "optics": {"positions": optics.positions, "misalignment_px": optics.misalignment_px},
        "files": listing(parts),
        "sensor": light,
        "seed": cfg.seed,
        "rates": _rates(cfg, True),
        "frames": {"windows": windows, "substeps": substeps, "crop": side},
    }
    gib = cfg.data.bank_gib
    if not isinstance(gib, int | float):
        raise ValueError(f"data.bank_gib must be a number, got {gib}")
    clips, frames = _count(cfg, "data.bank"), windows * substeps + 1
    return Bank(source, str(cfg.data.bank_root), made_of, clips=clips, frames=frames, gib=gib)


def _simulation(
    cfg: DictConfig, split: str, *, windows: int, optics: Optics, sensor: dict, crop, clips
) -> Pipeline:
    substeps = _count(cfg, "data.substeps")
    rates = _rates(cfg, split == "train")
    seed = _count(cfg, "data.test_seed" if split == "test" else "seed", least=0)
    scenes = [
        make(
            cfg.scene,
            split=split,
            seed=seed,
            frames=windows * substeps + 1,
            fps=rate * substeps,
        )
        for rate in rates
    ]
    try:
        return Pipeline(
            MixedRates(scenes) if len(scenes) > 1 else scenes[0],
            optics,
            _turbulence(cfg.turbulence),
            sensor,
            split=split,
            seed=seed,
            bins=cfg.bins,
            substeps=substeps,
            crop=crop,
            random_crop=split == "train",
            clips=clips,
        )
    except TypeError as error:
        raise ValueError(f"sensor takes no such values: {error}") from error


def _turbulence(node: DictConfig) -> TurbulenceModel:
    """Return the turbulence model; simulated air where none is named, as older runs name none."""
    return make(OmegaConf.merge({"_target_": SIMULATED}, node))


def _count(cfg: DictConfig, key: str, least: int = 1) -> int:
    value = OmegaConf.select(cfg, key)
    if type(value) is not int or value < least:
        raise ValueError(f"{key} must be a whole number >= {least}, got {value}")
    return value


def _rates(cfg: DictConfig, training: bool) -> list[float]:
    key = "data.rates" if training and cfg.data.rates else "fps"
    found = OmegaConf.select(cfg, key)
    rates = list(found) if isinstance(found, Sequence) else [found]
    if not rates or not all(isinstance(r, int | float) and 0 < r < math.inf for r in rates):
        raise ValueError(f"{key} must be > 0 windows a second, got {found}")
    return rates


def data(cfg: DictConfig, splits: tuple[str, ...] = ("train", "val", "test")) -> LightFieldData:
    """Return the data module with the pipelines of `splits`."""
    if not 0 <= cfg.data.warmup <= cfg.data.test_windows - 2:  # wobble needs two frames
        most = cfg.data.test_windows - 2
        raise ValueError(f"data.warmup must be in 0..{most} (windows), got {cfg.data.warmup}")
    pipelines = {split: pipeline(cfg, split) for split in splits}
    train = pipelines.get("train")
    return LightFieldData(
        pipelines,
        make(cfg.augment) if train else None,
        batch_size=cfg.data.batch_size,
        reuse=cfg.data.reuse,
        epoch_clips=cfg.data.epoch_clips,
        val_clips=cfg.data.val_clips,
        test_clips=cfg.data.test_clips,
        workers=cfg.data.workers,
        simulate_on=cfg.data.simulate_on,
        seed=cfg.seed,
        filler=Filler(train.bank) if isinstance(train, Banked) else None,
    )


def network(cfg: DictConfig) -> tuple[nn.Module, dict]:
    """Return a fresh network and the plain dict (target, kwargs) that builds it again.

    `model.weights`, which a network may be given published weights by, is no part of the dict.
    """
    node = OmegaConf.to_container(cfg.model, resolve=True)
    weights = node.pop("weights", None)
    net = make(node)
    if weights:
        widened.start(net, weights)
    elif "weights" in cfg.model:
        print(f"model.weights is null: {cfg.name} is trained from scratch")
    target = node.pop("_target_")
    return net, {"target": target, "kwargs": node}


def chosen(cfg: DictConfig) -> nn.Module:
    """Return the network that `ckpt` or else `baseline` names, in eval mode."""
    if cfg.ckpt:
        found = src.models.load(cfg.ckpt)
        if takes(found, "frames"):
            use = f"baseline=frames postprocess=mambatm postprocess.restorer={cfg.ckpt}"
            raise ValueError(f"ckpt must be a network for events, got a post-processor; use {use}")
        return found
    if cfg.get("baseline"):
        return make(cfg.baseline).eval()
    raise ValueError("ckpt or baseline must name a network, got neither")


def frozen(cfg: DictConfig) -> nn.Module:
    """Return the chosen network, behind it the chosen post-processor.

    Raises ValueError if it wants another number of views than `optics`.
    """
    found = chosen(cfg)
    wanted = found.views
    if wanted is not None and wanted != cfg.optics.views and not cfg.get("baseline"):
        raise ValueError(
            f"optics.views must be {wanted} for ckpt={cfg.ckpt}, got {cfg.optics.views}"
        )
    return make(cfg.postprocess, source=found) if cfg.get("postprocess") else found


def scores(cfg: DictConfig) -> Scores:
    """Return what is measured: without `metrics.lpips`, everything but LPIPS."""
    return Scores(make(cfg.metrics.lpips) if cfg.metrics.lpips else None, cfg.metrics.scale)


def reconstructor(cfg: DictConfig, net: nn.Module, spec: dict) -> Reconstructor:
    """Return the Lightning module that trains and tests `net`; with a `source`, on its frames."""
    kind = partial(Restoration, source=make(cfg.source)) if cfg.get("source") else Reconstructor
    if not 0 <= cfg.data.loss_from < cfg.data.windows:
        most = f"0..{cfg.data.windows - 1} (data.windows)"
        raise ValueError(f"data.loss_from must be in {most}, got {cfg.data.loss_from}")
    if cfg.hours and cfg.scheduler:
        raise ValueError(f"scheduler must be null with hours={cfg.hours}, which has its own")
    if cfg.channels_last:
        net.to(memory_format=torch.channels_last)
    return kind(
        net,
        spec,
        loss=make(cfg.loss),
        optimizer=make(cfg.optimizer),
        scheduler=make(cfg.scheduler) if cfg.scheduler else None,
        scores=scores(cfg),
        detach_every=cfg.data.detach_every,
        warmup=cfg.data.warmup,
        spike=cfg.spike,
        loss_from=cfg.data.loss_from,
        clip=cfg.clip,
        average=cfg.average,
        clock=Clock(cfg.clock),
    )


def share_cores(cfg: DictConfig) -> None:
    """Leave a core to each simulating worker: threads that fight for a core wait for each other.

    Threads are only taken away: a smaller OMP_NUM_THREADS stands.
    """
    if cfg.trainer.accelerator == "cpu":
        left = (os.cpu_count() or 1) - cfg.data.workers
        torch.set_num_threads(max(1, min(torch.get_num_threads(), left)))


def trainer(cfg: DictConfig) -> lightning.Trainer:
    """Return the trainer with its loggers and callbacks."""
    loggers = [make(logger) for logger in cfg.logger.values()]
    callbacks = [make(callback) for callback in cfg.callbacks.values()]
    return make(cfg.trainer, logger=loggers, callbacks=callbacks)


def test(
    cfg: DictConfig, name: str, net: nn.Module, data: LightFieldData, measures: Scores
) -> evaluation.Row:
    """Return the scores of `net` on the test clips; in float32, whatever it was trained in."""
    plain = {"precision": "32-true", "logger": False, "enable_checkpointing": False}
    plain |= {"devices": 1, "num_nodes": 1, "strategy": "auto"}  # of many, one process tests
    # On SLURM a trainer takes up what a preempted training left in its folder: this one has none.
    plain["default_root_dir"] = None
    quiet = make(cfg.trainer, callbacks=[], **plain)
    return evaluation.test(name, net, data, measures, trainer=quiet, warmup=cfg.data.warmup)
