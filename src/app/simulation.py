"""The simulation that a config asks for: scene, turbulence, optics and sensor of one split."""

import gc
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast
from weakref import WeakValueDictionary

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.app.instantiate import as_dict, build_part
from src.models.network import VideoMethod
from src.sim.optics import Optics, layout
from src.sim.pipeline import Pipeline
from src.sim.scenes.clip import FrameRateMixture
from src.sim.sensor.engine_input import NOISE_RATES
from src.sim.sensor.sensor import Sensor
from src.training.batch_sampler import LargeCropStream
from src.training.clip_cache import CachedPipeline, ClipCache, DeviceClipCache
from src.training.disk_cache import DiskClipCache, hash_file_lists

LARGE_PARTS = ("scene.", "sensor.", "turbulence.")  # what data.large.overrides may set
LARGE_KEYS = (
    "fps", "seed", "data.batch_size", "data.cache_clips", "data.cache_crop", "data.cache_device",
    "data.cache_gib", "data.cache_root", "data.cache_windows", "data.crop", "data.rates",
    "data.substeps", "data.train_clips", "data.windows",
)  # fmt: skip
NO_CLIPS = ("test_clips", "workers")  # keys of `data` that test clips do not follow from
DEVICE_CACHES: dict[str, DeviceClipCache] = {}  # those of this process, by all that makes them


def select_optics(cfg: DictConfig, net: VideoMethod) -> Optics:
    """Return the optics as `net` sees them: all views, or of them those that `net` wants.

    Raises ValueError where they have not got them.
    """
    whole = build_part(cfg, "optics")
    if net.views in (None, whole.views):
        return whole
    wanted = layout(net.views)
    if not set(wanted) <= set(whole.positions):
        name = cfg.ckpt or "this baseline"
        raise ValueError(f"optics.views must be {net.views} for {name}, got {whole.views}")
    return whole.select_views(wanted)


def check_unscored_windows(cfg: DictConfig) -> None:
    """Raise ValueError unless two windows of a test clip are scored, as many as jitter needs."""
    unscored, most = cfg.data.unscored_windows, cfg.data.test_windows - 2
    if most < 0:
        raise ValueError(f"data.test_windows must be >= 2, of which are scored, got {most + 2}")
    if not 0 <= unscored <= most:
        allowed = f"0..{most} (data.test_windows={most + 2} less two)"
        raise ValueError(f"data.unscored_windows must be in {allowed}, got {unscored}")


def build_pipeline(cfg: DictConfig, split: str, optics: Optics | None = None) -> Pipeline:
    """Return the simulation of one split: train, val or test; `optics`: others than `cfg`'s."""
    optics, test = optics or build_part(cfg, "optics"), "" if split == "train" else "test_"
    windows, crop = _count(cfg, f"data.{test}windows"), _side(cfg, f"data.{test}crop")
    clips = None if test or cfg.data.train_clips is None else _count(cfg, "data.train_clips")
    if test or cfg.data.get("cache_clips") is None:
        return _build_uncached_pipeline(cfg, split, optics, windows, crop, clips)
    return CachedPipeline(
        build_clip_cache(cfg),
        optics,
        build_sensor(cfg, _count(cfg, "seed", least=0)),
        windows=windows,
        bins=_count(cfg, "bins"),
        crop=crop,
        batch_size=_count(cfg, "data.batch_size"),
        shuffle_views=cfg.turbulence.get("views_correlation", "independent") == "independent",
        clips=clips,
    )


def describe_test_conditions(cfg: DictConfig, optics: Optics) -> str:
    """Return all that makes the test clips of this config, as seen by `optics`."""
    names = ("scene", "turbulence", "sensor", "optics", "data")
    parts: dict[str, Any] = {name: as_dict(cfg[name]) for name in names}
    parts["data"] = {key: value for key, value in parts["data"].items() if key not in NO_CLIPS}
    given = {key: cfg.get(key) for key in ("fps", "bins")}
    files = {"files": hash_file_lists(parts), "measured": _read_measured(parts["turbulence"])}
    return json.dumps([parts, given, files, optics.positions], sort_keys=True, default=str)


def build_clip_cache(cfg: DictConfig) -> ClipCache:
    """Return the cache of turbulence that `data.cache_clips` asks for, named by all that makes its
    clips; in a device's memory it is the same one for all that ask for the same in this process,
    where it stays until another is made after its last use.

    Nine views or fewer come out of one cache: view i depends on the draws of view i only.  Without
    turbulence all views are alike, so that there are as many as asked for.
    """
    optics, side = build_part(cfg, "optics"), _count(cfg, "data.cache_crop")
    clear = OmegaConf.select(cfg, "turbulence.atmosphere.severity") == "none"
    if not clear and set(optics.positions) <= set(layout(9)):
        optics = replace(optics, views=9, positions=layout(9))
    windows, substeps = _count(cfg, "data.cache_windows"), _count(cfg, "data.substeps")
    source = _build_uncached_pipeline(
        cfg, "train", optics, windows, side, crop_key="data.cache_crop"
    )
    gib, where = cfg.data.cache_gib, cfg.data.cache_device
    if not isinstance(gib, int | float):
        raise ValueError(f"data.cache_gib must be a number, got {gib}")
    size = {"clips": _count(cfg, "data.cache_clips"), "frames": windows * substeps + 1, "gib": gib}
    if where == "disk":
        return DiskClipCache(source, str(cfg.data.cache_root), _clip_inputs(cfg, optics), **size)
    if where != "device":
        raise ValueError(f"data.cache_device must be disk or device, got {where}")
    if workers := cfg.data.workers:
        raise ValueError(f"data.workers must be 0 for data.cache_device=device, got {workers}")
    accelerator = OmegaConf.select(cfg, "trainer.accelerator") or "cpu"  # none without a trainer
    device = "cpu" if accelerator == "cpu" else "cuda"
    name = json.dumps([_clip_inputs(cfg, optics), size, device], sort_keys=True)
    if name not in DEVICE_CACHES:
        _free_unused_device_caches()
        DEVICE_CACHES[name] = DeviceClipCache(source, device=device, **size)
    return DEVICE_CACHES[name]


def _free_unused_device_caches() -> None:
    """Free the caches that no pipeline has any more, of earlier jobs of a sweep."""
    used = WeakValueDictionary(DEVICE_CACHES)
    DEVICE_CACHES.clear()
    gc.collect()  # Lightning's objects refer to each other
    DEVICE_CACHES.update(used)


def build_large_crop_stream(
    cfg: DictConfig, optics: Optics | None = None
) -> LargeCropStream | None:
    """Return the second stream of training batches, of this config with `data.large.overrides`."""
    if not cfg.data.large or not cfg.data.large.share:
        return None
    other = merge_large_overrides(cfg)
    windows, first, pairs = other.data.windows, cfg.data.loss_from, cfg.data.loss_pairs
    least = first + (2 * pairs if pairs else 1)
    if type(windows) is not int or windows < least:
        wanted = f">= {least}, for data.loss_from={first} and data.loss_pairs={pairs}"
        raise ValueError(f"data.large: data.windows must be {wanted}, got {windows}")
    share, size = cfg.data.large.share, _count(other, "data.batch_size")
    if not isinstance(share, int | float):
        raise ValueError(f"data.large.share must be a number, got {share}")
    return LargeCropStream(build_pipeline(other, "train", optics), share, size)


def merge_large_overrides(cfg: DictConfig) -> DictConfig:
    """Return this config with `data.large.overrides`.

    Raises ValueError for overrides that are none, and for a key that both streams have in common.
    """
    for key in (str(line).partition("=")[0] for line in cfg.data.large.overrides):
        if key not in LARGE_KEYS and not key.startswith(LARGE_PARTS):
            allowed = ", ".join([*(f"{part}*" for part in LARGE_PARTS), *LARGE_KEYS])
            wanted = f"data.large.overrides must be [key=value, ...] with keys of {allowed}"
            raise ValueError(f"{wanted}, got {key}")
    try:
        changes = OmegaConf.from_dotlist(list(cfg.data.large.overrides))
        return cast(DictConfig, OmegaConf.merge(cfg, changes))
    except (OmegaConfBaseException, TypeError, ValueError) as error:
        raise ValueError(f"data.large.overrides must be [key=value, ...]: {error}") from error


def _clip_inputs(cfg: DictConfig, optics: Optics) -> dict:
    """Return all that makes the clips of a cache, as plain data."""
    parts = {name: as_dict(cfg[name]) for name in ("scene", "turbulence")}
    windows, substeps = cfg.data.cache_windows, cfg.data.substeps
    return parts | {
        "optics": optics.positions,
        "files": hash_file_lists(parts),
        "measured": _read_measured(parts["turbulence"]),
        "decodes_srgb": decodes_srgb(cfg),
        "seed": cfg.seed,
        "rates": _frame_rates(cfg, "train"),
        "frames": {"windows": windows, "substeps": substeps, "crop": cfg.data.cache_crop},
    }


def _read_measured(turbulence: dict) -> str | None:
    """Return what the file of `turbulence.measured` holds, which makes the clips."""
    measured = turbulence.get("measured")
    return Path(measured).read_text() if measured else None


def _build_uncached_pipeline(
    cfg: DictConfig, split: str, optics: Optics, windows: int, crop: Any, clips: int | None = None,
    crop_key: str = "",
) -> Pipeline:  # fmt: skip
    """Return the pipeline that simulates every clip, out of no cache."""
    substeps = _count(cfg, "data.substeps")
    seed = _count(cfg, "seed" if split == "train" else "data.test_seed", least=0)
    given = {"split": split, "seed": seed, "frames": windows * substeps + 1}
    rates = _frame_rates(cfg, split)
    sensor = build_sensor(cfg, seed)
    check_noise_rates(sensor, min(rates) * substeps)
    scenes = [build_part(cfg, "scene", fps=rate * substeps, **given) for rate in rates]
    return Pipeline(
        FrameRateMixture(scenes, split, seed) if len(scenes) > 1 else scenes[0],
        optics,
        build_part(cfg, "turbulence"),
        sensor,
        split=split,
        seed=seed,
        bins=_count(cfg, "bins"),
        substeps=substeps,
        crop=crop,
        crop_key=crop_key or ("data.crop" if split == "train" else "data.test_crop"),
        random_crop=split == "train",
        clips=clips,
        decodes_srgb=decodes_srgb(cfg),
    )


def check_noise_rates(sensor: Sensor, fps: float) -> None:
    """Raise ValueError where `sensor`, or what is drawn out of its `random`, could have more noise
    events a second and pixel than `fps`, the frames a second that are simulated.
    """
    limit = f"at most {fps:g}, the frames a second that are simulated"
    for name in NOISE_RATES:
        drawn = sensor.random.get(name, (0,))
        if max(drawn) > fps:
            raise ValueError(f"sensor.random.{name} must be {limit}, got up to {max(drawn)}")
        own = getattr(sensor, name, 0)
        if own > fps and name not in sensor.random:
            raise ValueError(f"sensor.{name} must be {limit}, got {own}")


def decodes_srgb(cfg: DictConfig) -> bool:
    """Return whether frames are decoded before the turbulence, which acts on light."""
    return cfg.sensor.get("input") == "srgb"


def build_sensor(cfg: DictConfig, seed: int) -> Sensor:
    light = {"input": "linear"} if decodes_srgb(cfg) else {}
    return build_part(cfg, "sensor", seed=seed, **light)


def _count(cfg: DictConfig, key: str, least: int = 1) -> int:
    value = OmegaConf.select(cfg, key)
    if type(value) is not int or value < least:
        raise ValueError(f"{key} must be a whole number >= {least}, got {value}")
    return value


def _side(cfg: DictConfig, key: str) -> Any:
    value = OmegaConf.select(cfg, key)
    if value is None or type(value) is int or (type(value) is float and 0 < value <= 1):
        return value
    if not isinstance(value, Sequence) or isinstance(value, str):
        wanted = "pixels (128), a share of the frame (0.5) or null"
        raise ValueError(f"{key} must be {wanted}, got {value}")
    if key != "data.crop" or cfg.data.get("cache_clips") is None:
        raise ValueError(f"{key} may be a range of sides with data.cache_clips only, got {value}")
    return list(value)


def _frame_rates(cfg: DictConfig, split: str) -> list[float]:
    key = "data.rates" if split == "train" and cfg.data.rates else "fps"
    given = OmegaConf.select(cfg, key)
    rates = list(given) if isinstance(given, Sequence) else [given]
    if not rates or not all(isinstance(r, int | float) and 1e-3 <= r <= 1e6 for r in rates):
        raise ValueError(f"{key} must be in [0.001, 1e6] windows a second, got {given}")
    return rates
