"""From a configuration to objects: with simulation.py, the one place below the doors that sees one.

What a config may name is decided in parts.py.
"""

import ctypes
import os
from functools import partial

import lightning
import torch
from lightning.pytorch.callbacks import ProgressBar
from omegaconf import DictConfig, OmegaConf
from torch import nn

import src.models
from baselines import widened
from baselines.postprocess import Restoration
from src.app.contracts import keeping
from src.app.parts import make, part, rooms
from src.app.simulation import large_stream, pipeline
from src.metrics.scores import Scores
from src.models.aligned import Aligned
from src.models.fast import computes_bf16
from src.models.look_ahead import LookAhead
from src.models.unroll import takes
from src.records.results import Row
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline
from src.training import evaluation
from src.training.bank import Bank
from src.training.bank_filler import Filler
from src.training.bank_samples import Banked
from src.training.batch_sampler import LargeStream
from src.training.clock import Clock
from src.training.datamodule import LightFieldData
from src.training.reconstructor import Reconstructor
from src.training.teachers import Teachers

STEPS = ("auto", "eager", "graph")
TRIM_THRESHOLD, MMAP_MAX = -1, -4  # of mallopt, in malloc.h


def data(
    cfg: DictConfig,
    splits: tuple[str, ...] = ("train", "val", "test"),
    optics: Optics | None = None,
) -> LightFieldData:
    """Return the data module with the pipelines of `splits`; `optics`: others than `cfg`'s."""
    if not 0 <= cfg.data.warmup <= cfg.data.test_windows - 2:  # wobble needs two frames
        most = cfg.data.test_windows - 2
        raise ValueError(f"data.warmup must be in 0..{most} (windows), got {cfg.data.warmup}")
    pipelines = {split: pipeline(cfg, split, optics) for split in splits}
    train = pipelines.get("train")
    large = large_stream(cfg, optics) if train else None
    return LightFieldData(
        pipelines,
        part(cfg, "augment") if train else None,
        batch_size=cfg.data.batch_size,
        reuse=cfg.data.reuse,
        epoch_clips=cfg.data.epoch_clips,
        val_clips=cfg.data.val_clips,
        test_clips=cfg.data.test_clips,
        workers=cfg.data.workers,
        simulate_on=cfg.data.simulate_on,
        seed=cfg.seed,
        filler=_filler(train, large),
        large=large,
        teachers=teachers(cfg, train.optics.views) if train and cfg.get("teachers") else None,
    )


def _filler(train: Pipeline | None, large: LargeStream | None) -> Filler | None:
    """Return what fills the banks on a disk, the one of few large clips first."""
    streams = [*([large.pipeline] if large else []), train]
    banks = [one.bank for one in streams if isinstance(one, Banked) and isinstance(one.bank, Bank)]
    return Filler(*banks) if banks else None


def teachers(cfg: DictConfig, views: int) -> Teachers:
    """Return the networks that `teachers` names.

    Raises ValueError, naming the key, where one is not there or wants other views.
    """
    names = [cfg.teachers] if isinstance(cfg.teachers, str) else list(cfg.teachers)
    try:
        networks = {name: src.models.load(name, rooms(cfg)) for name in names}
    except ValueError as error:
        raise ValueError(f"teachers must be networks: {error}") from error
    for name, net in networks.items():
        if net.views not in (None, views):
            raise ValueError(f"teachers must take optics.views={views}, {name} takes {net.views}")
    rates = tuple(cfg.data.rates or ())
    return Teachers(networks, cfg.teachers_root, cfg.fps, rates)


def network(cfg: DictConfig) -> tuple[nn.Module, dict]:
    """Return a fresh network and the plain dict (target, kwargs) that builds it again.

    `model.weights`, which a network may be given published weights by, is no part of the dict.
    """
    node = OmegaConf.to_container(cfg.model, resolve=True)
    weights = node.pop("weights", None)
    net = keeping("model", make(node, rooms(cfg)))
    if weights:
        widened.start(net, weights)
    elif "weights" in cfg.model:
        print(f"model.weights is null: {cfg.name} is trained from scratch")
    target = node.pop("_target_")
    if hasattr(net, "arguments"):  # made by a preset: what the preset stands for
        return net, {"target": target.removesuffix(".preset"), "kwargs": net.arguments}
    return net, {"target": target, "kwargs": node}


def chosen(cfg: DictConfig) -> nn.Module:
    """Return the network that `ckpt` or else `baseline` names, in eval mode."""
    if cfg.ckpt:
        net = src.models.load(cfg.ckpt, rooms(cfg))
        if takes(net, "frames"):
            use = f"baseline=frames postprocess=mambatm postprocess.restorer={cfg.ckpt}"
            raise ValueError(f"ckpt must be a network for events, got a post-processor; use {use}")
        return net
    if cfg.get("baseline"):
        return part(cfg, "baseline").eval()
    raise ValueError("ckpt or baseline must name a network, got neither")


def frozen(cfg: DictConfig) -> nn.Module:
    """Return the chosen network, its views aligned, with its look ahead and behind it the chosen
    post-processor.
    """
    net = chosen(cfg)
    if cfg.get("align"):
        net = Aligned(net, cfg.align)
    if cfg.get("look_ahead_s"):
        net = LookAhead(net, cfg.look_ahead_s)
    return part(cfg, "postprocess", source=net) if cfg.get("postprocess") else net


def scores(cfg: DictConfig) -> Scores:
    """Return what is measured: without `metrics.lpips`, everything but LPIPS."""
    lpips = part(cfg, "metrics.lpips") if cfg.metrics.lpips else None
    return Scores(lpips, cfg.metrics.scale)


def reconstructor(cfg: DictConfig, net: nn.Module, spec: dict) -> Reconstructor:
    """Return the Lightning module that trains and tests `net`; with a `source`, on its frames."""
    kind = Reconstructor
    if cfg.get("source"):
        kind = partial(Restoration, source=part(cfg, "source"))
    if not 0 <= cfg.data.loss_from < cfg.data.windows:
        most = f"0..{cfg.data.windows - 1} (data.windows)"
        raise ValueError(f"data.loss_from must be in {most}, got {cfg.data.loss_from}")
    pairs, most = cfg.data.loss_pairs, (cfg.data.windows - cfg.data.loss_from) // 2
    if pairs is not None and not (type(pairs) is int and 1 <= pairs <= most):
        raise ValueError(f"data.loss_pairs must be in 1..{most} or null, got {pairs}")
    if cfg.hours and cfg.scheduler:
        raise ValueError(f"scheduler must be null with hours={cfg.hours}, which has its own")
    if cfg.channels_last:
        for layer in (layer for layer in net.modules() if isinstance(layer, nn.Conv2d)):
            layer.to(memory_format=torch.channels_last)
    return kind(
        net,
        spec,
        loss=part(cfg, "loss"),
        optimizer=part(cfg, "optimizer"),
        scheduler=part(cfg, "scheduler") if cfg.scheduler else None,
        scores=scores(cfg),
        detach_every=cfg.data.detach_every,
        warmup=cfg.data.warmup,
        spike=cfg.spike,
        loss_from=cfg.data.loss_from,
        loss_pairs=cfg.data.loss_pairs,
        steady=cfg.steady,
        calm=cfg.calm,
        teach=cfg.teach,
        clip=cfg.clip,
        average=cfg.average,
        clock=Clock(cfg.clock),
        graphs=_graphs(cfg),
    )


def _graphs(cfg: DictConfig) -> bool:
    """Return whether a step runs as CUDA graphs; raises ValueError for a step that there is not."""
    if cfg.step not in STEPS:
        raise ValueError(f"step must be one of {', '.join(STEPS)}, got {cfg.step}")
    on_gpu = cfg.trainer.accelerator != "cpu" and torch.cuda.is_available()
    whole = not cfg.data.detach_every and cfg.trainer.devices == 1 and not cfg.get("source")
    if cfg.step == "graph" and not (on_gpu and whole):
        raise ValueError(
            "step must be auto or eager without a GPU, on several, with data.detach_every and for "
            "a post-processor, got graph"
        )
    return cfg.step != "eager" and on_gpu and whole


def share_cores(cfg: DictConfig) -> None:
    """Leave a core to each simulating worker: threads that fight for a core wait for each other.

    Threads are only taken away: a smaller OMP_NUM_THREADS stands.
    """
    if cfg.trainer.accelerator == "cpu":
        left = (os.cpu_count() or 1) - cfg.data.workers
        torch.set_num_threads(max(1, min(torch.get_num_threads(), left)))


def keep_memory(cfg: DictConfig) -> None:
    """Let a training on a CPU keep the memory that it frees, as far as the C library is glibc.

    Its maps come and go in every step; given back to the system and had again, page by page, they
    take an eighth of the time.
    """
    library = ctypes.CDLL(None)
    if cfg.trainer.accelerator == "cpu" and hasattr(library, "mallopt"):
        library.mallopt(MMAP_MAX, 0)
        library.mallopt(TRIM_THRESHOLD, -1)  # never


def choose_precision(cfg: DictConfig) -> None:
    """Where `trainer.precision` is null write the faster there: bf16, but on most CPUs float32."""
    if cfg.trainer.precision is None:
        half = cfg.trainer.accelerator != "cpu" or computes_bf16()
        cfg.trainer.precision = "bf16-mixed" if half else "32-true"


def trainer(cfg: DictConfig) -> lightning.Trainer:
    """Return the trainer with its loggers and callbacks."""
    # Part of trainer.deterministic that finds mistakes and changes no result, for 4 % of a step.
    torch.utils.deterministic.fill_uninitialized_memory = False
    loggers = [make(logger, rooms(cfg)) for logger in cfg.logger.values()]
    callbacks = [make(callback, rooms(cfg)) for callback in cfg.callbacks.values()]
    if not cfg.trainer.enable_progress_bar:  # Lightning refuses a bar then
        callbacks = [callback for callback in callbacks if not isinstance(callback, ProgressBar)]
    return part(cfg, "trainer", logger=loggers, callbacks=callbacks)


def test(cfg: DictConfig, name: str, net: nn.Module, data: LightFieldData, measures: Scores) -> Row:
    """Return the scores of `net` on the test clips; in float32, whatever it was trained in."""
    plain = {"precision": "32-true", "logger": False, "enable_checkpointing": False}
    plain |= {"devices": 1, "num_nodes": 1, "strategy": "auto"}  # of many, one process tests
    # On SLURM a trainer takes up what a preempted training left in its folder: this one has none.
    plain["default_root_dir"] = None
    quiet = part(cfg, "trainer", callbacks=[], **plain)
    return evaluation.test(name, net, data, measures, trainer=quiet, warmup=cfg.data.warmup)
