"""The simulation that a config asks for: scenes, air, optics and sensor of one split, or a bank."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn

from src.app.parts import part
from src.sim.optics import Optics, layout
from src.sim.pipeline import Pipeline
from src.sim.scenes.photographs import MixedRates
from src.sim.sensor.contract import Sensor
from src.training.bank import Bank, listing
from src.training.bank_samples import Banked
from src.training.batch_sampler import LargeStream
from src.training.device_cache import DeviceCache

CLIP = ("scene", "turbulence")  # sections that make a clip, whatever sees it
DEVICE_CACHES: dict[str, DeviceCache] = {}  # those of this process, by all that makes them


def light_field(cfg: DictConfig, net: nn.Module) -> Optics:
    """Return the optics as `net` sees them: all views, or of them those that `net` wants.

    Raises ValueError where they have not got them.
    """
    whole = part(cfg, "optics")
    if net.views in (None, whole.views):
        return whole
    wanted = layout(net.views)
    if not set(wanted) <= set(whole.positions):
        name = cfg.ckpt or "this baseline"
        raise ValueError(f"optics.views must be {net.views} for {name}, got {whole.views}")
    return whole.only(wanted)


def pipeline(cfg: DictConfig, split: str, optics: Optics | None = None) -> Pipeline:
    """Return the simulation of one split: train, val or test; `optics`: others than `cfg`'s."""
    training = split == "train"
    clips = _count(cfg, "data.clips") if training and cfg.data.clips is not None else None
    if training and cfg.data.get("bank") is not None:
        return Banked(
            bank(cfg),
            optics or part(cfg, "optics"),
            _sensor(cfg, _count(cfg, "seed", least=0)),
            windows=_count(cfg, "data.windows"),
            bins=_count(cfg, "bins"),
            crop=_side(cfg, "data.crop", ranges=True),
            together=_count(cfg, "data.batch_size"),
            independent=cfg.turbulence.get("views_correlation", "independent") == "independent",
            clips=clips,
        )
    return _simulation(
        cfg,
        split,
        windows=_count(cfg, "data.windows" if training else "data.test_windows"),
        optics=optics or part(cfg, "optics"),
        crop=_side(cfg, "data.crop" if training else "data.test_crop"),
        clips=clips,
    )


def bank(cfg: DictConfig) -> Bank | DeviceCache:
    """Return the cache of turbulence that `data.bank` asks for, named by all that makes its clips;
    in a device's memory it is the same one for all that ask for the same in this process.

    Nine views or fewer come out of one cache: view i depends on the draws of view i only.  Without
    turbulence all views are alike, so that there are as many as asked for.
    """
    optics, side = part(cfg, "optics"), _count(cfg, "data.bank_crop")
    clear = OmegaConf.select(cfg, "turbulence.atmosphere.severity") == "none"
    if not clear and set(optics.positions) <= set(layout(9)):
        optics = replace(optics, views=9, positions=layout(9))
    windows, substeps = _count(cfg, "data.bank_windows"), _count(cfg, "data.substeps")
    source = _simulation(cfg, "train", windows=windows, optics=optics, crop=side, clips=None)
    gib, where = cfg.data.bank_gib, cfg.data.bank_on
    if not isinstance(gib, int | float):
        raise ValueError(f"data.bank_gib must be a number, got {gib}")
    size = {"clips": _count(cfg, "data.bank"), "frames": windows * substeps + 1, "gib": gib}
    if where == "disk":
        return Bank(source, str(cfg.data.bank_root), _made_of(cfg, optics), **size)
    if where != "device":
        raise ValueError(f"data.bank_on must be disk or device, got {where}")
    if cfg.data.workers:
        raise ValueError(f"data.workers must be 0 for data.bank_on=device, got {cfg.data.workers}")
    device = "cpu" if cfg.trainer.accelerator == "cpu" else "cuda"
    name = json.dumps([_made_of(cfg, optics), size, device], sort_keys=True)
    if name not in DEVICE_CACHES:
        DEVICE_CACHES[name] = DeviceCache(source, device=device, **size)
    return DEVICE_CACHES[name]


def large_stream(cfg: DictConfig, optics: Optics | None = None) -> LargeStream | None:
    """Return the second stream of training batches that `data.large` asks for: of this config, its
    `overrides` changed.  Raises ValueError for overrides that are none.
    """
    if not cfg.data.large or not cfg.data.large.share:
        return None
    try:
        changes = OmegaConf.from_dotlist(list(cfg.data.large.overrides))
        other = OmegaConf.merge(cfg, changes)
    except (OmegaConfBaseException, TypeError, ValueError) as error:
        raise ValueError(f"data.large.overrides must be [key=value, ...]: {error}") from error
    if not other.data.loss_from < other.data.windows:
        least = f"> data.loss_from, {other.data.loss_from}"
        raise ValueError(f"data.large: data.windows must be {least}, got {other.data.windows}")
    size = _count(other, "data.batch_size")
    return LargeStream(pipeline(other, "train", optics), cfg.data.large.share, size)


def _made_of(cfg: DictConfig, optics: Optics) -> dict:
    """Return all that makes the clips of a cache, as plain data."""
    parts = {name: OmegaConf.to_container(cfg[name], resolve=True) for name in CLIP}
    measured = parts["turbulence"].get("measured")  # a file; what it holds makes the clips
    windows, substeps = cfg.data.bank_windows, cfg.data.substeps
    return parts | {
        "optics": {"positions": optics.positions, "misalignment_px": optics.misalignment_px},
        "files": listing(parts),
        "measured": Path(measured).read_text() if measured else None,
        "sensor": _light(cfg),
        "seed": cfg.seed,
        "rates": _rates(cfg, True),
        "frames": {"windows": windows, "substeps": substeps, "crop": cfg.data.bank_crop},
    }


def _simulation(
    cfg: DictConfig, split: str, *, windows: int, optics: Optics, crop, clips
) -> Pipeline:
    substeps = _count(cfg, "data.substeps")
    rates = _rates(cfg, split == "train")
    seed = _count(cfg, "seed" if split == "train" else "data.test_seed", least=0)
    frames = windows * substeps + 1
    scenes = [
        part(cfg, "scene", split=split, seed=seed, frames=frames, fps=rate * substeps)
        for rate in rates
    ]
    made = Pipeline(
        MixedRates(scenes) if len(scenes) > 1 else scenes[0],
        optics,
        part(cfg, "turbulence"),
        _light(cfg),
        split=split,
        seed=seed,
        bins=_count(cfg, "bins"),
        substeps=substeps,
        crop=crop,
        random_crop=split == "train",
        clips=clips,
    )
    made.sensor = _sensor(cfg, seed)
    return made


def _light(cfg: DictConfig) -> dict:
    """Return what decides about the light in front of the sensor: whether frames are decoded."""
    return {"input": "srgb" if cfg.sensor.get("input") == "srgb" else "linear"}


def _sensor(cfg: DictConfig, seed: int) -> Sensor:
    """Return the sensor; what is decoded before the turbulence reaches it as light."""
    decoded = {"input": "linear"} if _light(cfg)["input"] == "srgb" else {}
    return part(cfg, "sensor", seed=seed, **decoded)


def _count(cfg: DictConfig, key: str, least: int = 1) -> int:
    value = OmegaConf.select(cfg, key)
    if type(value) is not int or value < least:
        raise ValueError(f"{key} must be a whole number >= {least}, got {value}")
    return value


def _side(cfg: DictConfig, key: str, ranges: bool = False) -> int | float | Sequence[int] | None:
    value = OmegaConf.select(cfg, key)
    if value is None or type(value) in (int, float):
        return value
    if isinstance(value, Sequence) and not isinstance(value, str):
        if ranges:
            return list(value)
        raise ValueError(f"{key} may be a range of sides with data.bank only, got {value}")
    raise ValueError(f"{key} must be pixels (128), a share of the frame (0.5) or null, got {value}")


def _rates(cfg: DictConfig, training: bool) -> list[float]:
    key = "data.rates" if training and cfg.data.rates else "fps"
    given = OmegaConf.select(cfg, key)
    rates = list(given) if isinstance(given, Sequence) else [given]
    if not rates or not all(isinstance(r, int | float) and 0 < r < math.inf for r in rates):
        raise ValueError(f"{key} must be > 0 windows a second, got {given}")
    return rates
