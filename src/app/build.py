"""What trains and tests with Lightning, from a configuration; tested networks: methods.py."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import ProgressBar
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from baselines.postprocess import Postprocessed
from src.app.hardware import first_requested_gpu, uses_cuda_graphs
from src.app.instantiate import (
    as_dict,
    build_part,
    check_contract,
    instantiate_node,
    read_user_packages,
)
from src.app.methods import load_network_of_kind
from src.app.metrics import build_metrics
from src.app.simulation import (
    build_large_crop_stream,
    build_pipeline,
    check_unscored_windows,
    describe_test_conditions,
)
from src.losses.terms import TrainingLoss
from src.metrics.video_metrics import VideoMetrics
from src.models import files
from src.models.network import EventToVideoNetwork, FramePostprocessor, VideoMethod
from src.models.setnet import SetNet
from src.records.atomic import check_writable
from src.records.results import ScoreRow
from src.sim.optics import Optics
from src.sim.pipeline import Sample
from src.sim.scenes.photo_files import decode_photograph
from src.training import evaluation
from src.training.clip_cache import CachedPipeline
from src.training.datamodule import LightFieldData
from src.training.disk_cache import CacheFillerProcess, DiskClipCache
from src.training.ema import WeightEMA
from src.training.progress import TrainingProgress
from src.training.reconstructor import PostprocessorTraining, Reconstructor
from src.training.sample_store import SampleStore
from src.training.schedule import TrainingClock
from src.training.step_guard import StepGuard
from src.training.teachers import TeacherEnsemble

DATA_OPTIONS = (
    "batch_size", "batch_reuse", "epoch_clips", "val_clips", "test_clips", "workers", "simulate_on",
)  # fmt: skip
SWEEP_STORE = SampleStore()  # of the jobs of a sweep that run in this process
SMALL_PHOTOGRAPH_BYTES = 4096
FIXED_TRAINER_OPTIONS = {  # the only value, and what is there instead
    "accumulate_grad_batches": (1, "data.batch_size is that of a step"),
    "gradient_clip_val": (0, "grad_clip_norm is the largest gradient of a step"),
    "overfit_batches": (0, "debug=overfit trains on a few clips again and again"),
}
Trainable = EventToVideoNetwork | FramePostprocessor


def build_data_module(
    cfg: DictConfig, splits: tuple[str, ...] = ("train", "val", "test"),
    optics: Optics | None = None,
) -> LightFieldData:  # fmt: skip
    """Return the data module with the pipelines of `splits`; `optics`: others than `cfg`'s.

    Raises ValueError as `check_small_photographs` does.
    """
    check_unscored_windows(cfg)
    pipelines = {split: build_pipeline(cfg, split, optics) for split in splits}
    for pipeline in pipelines.values():
        check_small_photographs(pipeline.scene)
    train = pipelines.get("train")
    large = build_large_crop_stream(cfg, optics) if train else None
    streams = [*([large.pipeline] if large else []), train]  # the few large clips first
    caches = [stream.cache for stream in streams if isinstance(stream, CachedPipeline)]
    on_disk = [cache for cache in caches if isinstance(cache, DiskClipCache)]
    in_sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    test = pipelines.get("test")
    return LightFieldData(
        pipelines,
        build_part(cfg, "augment") if train else None,
        **{name: cfg.data[name] for name in DATA_OPTIONS},
        seed=cfg.seed,
        filler=CacheFillerProcess(*on_disk) if on_disk else None,
        large=large,
        test_store=SWEEP_STORE if in_sweep else None,
        test_conditions=describe_test_conditions(cfg, test.optics) if in_sweep and test else "",
        teachers=build_teachers(cfg, train.optics.views) if train and cfg.get("teachers") else None,
    )


def build_teachers(cfg: DictConfig, views: int) -> TeacherEnsemble:
    """Return the networks that `teachers` names.

    Raises ValueError, naming the key, where one is not there or wants other views.
    """
    networks = {}
    for name in [cfg.teachers] if isinstance(cfg.teachers, str) else cfg.teachers:
        net = load_network_of_kind(EventToVideoNetwork, cfg, name, "teachers must be networks")
        if net.views not in (None, views):
            raise ValueError(f"teachers must take optics.views={views}, {name} takes {net.views}")
        networks[name] = net
    check_writable(Path(cfg.distillation_cache) / "frames.pt", "distillation_cache")
    rates = tuple(cfg.data.rates or ())
    return TeacherEnsemble(networks, cfg.distillation_cache, cfg.fps, rates)


def check_small_photographs(scene: Any) -> None:
    """Raise ValueError for a file of few bytes among the photographs of `scene` that cannot be read
    or is below 16 px: a clip would meet it late.  Larger files are read as clips show them."""
    for part in getattr(scene, "scenes", ()):
        check_small_photographs(part)
    for photo in getattr(scene, "photos", ()):
        if isinstance(photo, Path) and photo.stat().st_size < SMALL_PHOTOGRAPH_BYTES:
            decode_photograph(photo)


def build_untrained_network(cfg: DictConfig) -> tuple[Trainable, dict]:
    """Return a fresh network and the plain dict (target, kwargs) that builds it again.

    Raises ValueError, naming the key, for values that its file could not be loaded with.
    """
    node = as_dict(cfg.model)
    for name, value in node.items():
        files.check_sizes(str(node.get("_target_")), value, f"model.{name}")
    net = check_contract("model", instantiate_node(node, read_user_packages(cfg)))
    target = node.pop("_target_")
    if isinstance(net, SetNet):  # the arguments that a preset stands for
        return net, {"target": target.removesuffix(".preset"), "kwargs": net.init_kwargs}
    return net, {"target": target, "kwargs": node}


def build_loss(cfg: DictConfig) -> TrainingLoss:
    """Return the sum of the terms of `loss` whose weight is not 0."""
    terms = {}
    for name, node in cfg.loss.items():
        if not isinstance(node, DictConfig):
            raise ValueError(f"loss.{name} must be a term (loss.{name}.weight=...), got {node}")
        weight = node.get("weight", 1.0)
        if not (isinstance(weight, int | float) and 0 <= weight < math.inf):
            raise ValueError(f"loss.{name}.weight must be >= 0, got {weight}")
        if weight:
            terms[name] = build_part(cfg, f"loss.{name}")
    _check_distillation(cfg)
    return TrainingLoss(terms)


def _check_distillation(cfg: DictConfig) -> None:
    """Raise ValueError for teachers whose frames are compared with nothing, and for a weight that
    was chosen without teachers."""
    weight, teachers = OmegaConf.select(cfg, "loss.distillation.weight"), cfg.get("teachers")
    if teachers and not weight:
        raise ValueError(f"loss.distillation.weight must be > 0 with teachers, got {weight}")
    if not teachers and weight not in (None, 0, 1):  # 1: that of conf/loss/terms.yaml
        raise ValueError(f"loss.distillation.weight must be 0 or 1 without teachers, got {weight}")


def build_reconstructor(cfg: DictConfig, net: Trainable, spec: dict) -> Reconstructor:
    """Return the Lightning module that trains and tests `net`; with a `source`, on its frames."""
    data = cfg.data
    if not 0 <= data.loss_from < (windows := data.windows):
        raise ValueError(f"data.loss_from must be in 0..{windows - 1}, got {data.loss_from}")
    pairs, most = data.loss_pairs, (data.windows - data.loss_from) // 2
    if pairs is not None and not (type(pairs) is int and 1 <= pairs <= most):
        raise ValueError(f"data.loss_pairs must be in 1..{most} or null, got {pairs}")
    if cfg.train_hours and cfg.scheduler:
        raise ValueError(f"scheduler must be null with train_hours={cfg.train_hours}")
    if cfg.scheduler and (length := cfg.scheduler.get("T_max")) is not None and length < 1:
        why = "it follows trainer.max_steps; scheduler=null keeps the rate"
        raise ValueError(f"scheduler.T_max must be >= 1, got {length}: {why}")
    for key in ("batch_view_dropout_probability", "batch_centre_view_probability"):
        if OmegaConf.select(cfg, f"augment.{key}") and getattr(net, "views", None) is not None:
            takes = f"this network takes {net.views} views"
            raise ValueError(f"augment.{key} must be 0, got {cfg.augment[key]}: {takes}")
    if cfg.channels_last:
        for layer in (layer for layer in net.modules() if isinstance(layer, nn.Conv2d)):
            layer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer, scheduler = _build_optimizer(cfg)
    kind, method = Reconstructor, None
    if cfg.get("source"):
        assert isinstance(net, FramePostprocessor)
        source = build_part(cfg, "source").eval().requires_grad_(False)
        kind, method = PostprocessorTraining, Postprocessed(source, net)
    return kind(
        net,
        spec,
        loss=build_loss(cfg),
        optimizer=optimizer,
        scheduler=scheduler,
        metrics=build_metrics(cfg),
        method=method,
        loss_from=data.loss_from,
        loss_pairs=pairs,
        guard=StepGuard(cfg.loss_spike_factor, cfg.grad_clip_norm),
        clock=TrainingClock(cfg.train_clock),
        cuda_graphs=uses_cuda_graphs(cfg),
        unscored_windows=data.unscored_windows,
        seed=cfg.seed,
    )


def _build_optimizer(cfg: DictConfig) -> tuple[Callable, Callable | None]:
    """Return what makes the optimiser of parameters and the scheduler, if any, of an optimiser.

    Raises ValueError, before anything is trained, for values that one of them refuses.
    """
    trial: Any = [nn.Parameter(torch.zeros(1))]
    parts = dict[str, Callable]()
    trial[0].grad = torch.zeros(1)
    for key in ("optimizer", "scheduler") if cfg.scheduler else ("optimizer",):
        parts[key] = build_part(cfg, key)
        try:
            trial = parts[key](trial)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the scheduler's optimiser takes no steps
                trial.step()  # as in training: without a closure or a score
        except (TypeError, ValueError) as error:
            raise ValueError(f"{key} takes no such values: {error}") from error
    return parts["optimizer"], parts.get("scheduler")


def build_trainer(cfg: DictConfig) -> lightning.Trainer:
    """Return the trainer with its loggers and callbacks.

    Raises ValueError for options of Lightning that steps taken by hand exclude.
    """
    for key, (allowed, instead) in FIXED_TRAINER_OPTIONS.items():
        if (value := cfg.trainer.get(key)) not in (None, allowed):
            raise ValueError(f"trainer.{key} must be {allowed} or null, got {value}: {instead}")
    # Part of trainer.deterministic that finds mistakes and changes no result, for 4 % of a step.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    packages = read_user_packages(cfg)
    loggers = [instantiate_node(node, packages) for node in cfg.logger.values()]
    callbacks = [instantiate_node(node, packages) for node in cfg.callbacks.values()]
    if cfg.ema_decay is not None:  # first, so that what the others see is of the same step
        callbacks.insert(0, WeightEMA(cfg.ema_decay))
    if not cfg.trainer.enable_progress_bar:  # Lightning refuses a bar then
        callbacks = [callback for callback in callbacks if not isinstance(callback, ProgressBar)]
    return build_part(cfg, "trainer", logger=loggers, callbacks=callbacks)


def test_method(
    cfg: DictConfig, name: str, net: VideoMethod, data: LightFieldData, metrics: VideoMetrics,
    kept_clips: int = 0,
) -> tuple[ScoreRow, list[tuple[Sample, Tensor]]]:  # fmt: skip
    """Return the scores of `net` on the test clips, in float32, whatever it was trained in, and the
    first `kept_clips` of them, each with its reconstruction; on the first of several devices."""
    # On SLURM a trainer takes up what a preempted training left in its folder: this one has none.
    options: dict = {"precision": "32-true", "logger": False, "enable_checkpointing": False}
    options |= {"num_nodes": 1, "strategy": "auto", "default_root_dir": None}
    options["devices"] = [first_requested_gpu(cfg)] if cfg.trainer.accelerator == "gpu" else 1
    callbacks = [TrainingProgress(tested=name)] if cfg.trainer.enable_progress_bar else []
    trainer = build_part(cfg, "trainer", callbacks=callbacks, **options)
    options = {"unscored_windows": cfg.data.unscored_windows, "kept_clips": kept_clips}
    return evaluation.test_network(name, net, data, metrics, trainer=trainer, **options)
