"""The values of a configuration, checked against the shipped one before anything runs.

A value must be of the kind that the shipped config has there: number, word, true or false, list or
mapping.  What is null there, or may be of several kinds, is listed below.
"""

import math
import re
from collections.abc import Iterator
from typing import Any, cast

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.app.path_overrides import is_path_key
from src.app.renamed_keys import describe_unknown_key, flatten_keys
from src.models.size_limit import MAX_SIZE
from src.recordings.sensor_limits import LARGEST_SIDE, are_sensor_sides

NUMBER, WHOLE, WORD, FLAG = "a number", "a whole number", "a word", "true or false"
LIST, MAPPING, NULL = "a list", "a mapping", "null"
KEYS: dict[tuple[str, ...], str] = {
    (NUMBER, NULL): """
        noise_filter_s train_hours grad_clip_norm ema_decay state_rounding_step
        loss_spike_factor turbulence.wind_m_s turbulence.baseline_m
        callbacks.learning_curve.interval_h data.max_grid_s data.start_s data.end_s
        calibrate:fps simulate:fps camera.tile_px white_level compare:still data.test_crop
        simulate:seconds
    """,
    (WHOLE, NULL): """
        data.train_clips data.cache_clips data.loss_pairs dots.fit_radius_px last stem
        longest_side_px
    """,
    (WHOLE,): """
        bins seed index clips processes port max_waiting_windows frames_shown first
        air.max_frames dots.rows dots.cols data.batch_size data.test_seed data.batch_reuse
        data.epoch_clips data.windows data.substeps data.workers data.test_windows
        data.test_clips data.val_clips data.unscored_windows data.loss_from
        data.events_per_window trainer.max_steps callbacks.rotation.every_n_train_steps
        augment.max_view_shift_px optics.views width scene.height scene.width sample_clips
        live:threads
    """,
    (LIST, NULL): "sensor_size resolution line circle spin names data.rates",
    (LIST,): "videos offered_networks allowed_origins",
    (WORD, LIST, NULL): "teachers against chart:ckpt stress:ckpt",
    (WORD, NULL): """
        train:start data.test_set data.grid_edges data.output_normalisation window_length
        form
    """,
    (WORD, LIST): "run",
    (NUMBER, LIST, NULL): "data.crop",
    (WORD, FLAG): "cuda_graphs trainer.deterministic",
    (WORD, WHOLE): "views_used",
    (WORD, NUMBER, NULL): "trainer.precision",
    (NUMBER, WORD, LIST): "trainer.devices",
    (MAPPING, NULL): "data.large",
}
BOUNDS: dict[str, tuple[int, float]] = {  # of what others would refuse without its key
    "bins": (1, 1000), "data.substeps": (1, 10_000), "data.windows": (1, 10**6),
    "data.test_windows": (1, 10**6), "data.cache_windows": (1, 10**6),
    "data.test_clips": (1, math.inf), "data.val_clips": (0, math.inf),
    "data.workers": (0, 1024), "trainer.check_val_every_n_epoch": (1, math.inf),
    "index": (0, math.inf), "sample_clips": (0, math.inf), "seed": (0, 2**32 - 1),
    "width": (1, MAX_SIZE), "stem": (1, MAX_SIZE),
    "callbacks.rotation.every_n_train_steps": (1, math.inf),
}  # fmt: skip
DDP_PROCESS = r"_ddp_process_\d+$"  # what Lightning adds to the name of a job
CHOICES = {"trainer.accelerator": ("cpu", "gpu")}
KINDS = {key: kinds for kinds, keys in KEYS.items() for key in keys.split()}
# Parts whose own classes check whether a number, a range of numbers or null does.
RANGES = ("augment.", "optics.", "user_clip_sensor.", "scene.", "sensor.", "target.", "turbulence.")
SIZES = ("sensor_size", "resolution", "camera.sensor_size")  # [height, width]
# More entries do.
OPEN = ("callbacks", "logger", "loss", "networks", "references", "scene.parts", "stress_tests")


def check_values(cfg: DictConfig) -> None:
    """Raise ValueError for a value of another kind than its key's, and for a key that is none, in
    the config of this job of Hydra's."""
    if (shipped := _shipped_config()) is not None:
        name = HydraConfig.get().job.name  # of the entry point, for a sweep's config too
        check_values_like(cfg, shipped, re.sub(DDP_PROCESS, "", name))


def check_values_like(cfg: DictConfig, shipped: DictConfig, entry_point: str) -> None:
    """Raise ValueError as `check_values`; `shipped`: the config of `entry_point` with the choices
    of groups of `cfg` but no other override.
    """
    given, plain = (
        cast(dict, OmegaConf.to_container(config, resolve=False)) for config in (cfg, shipped)
    )
    for key, value in _walk(given, plain):
        if not _is_known(key, value, given, plain):
            raise ValueError(describe_unknown_key(key, list(flatten_keys(plain))))
        unresolved = _at(plain, key)
        if isinstance(value, str) and "${" in value:
            if value == unresolved:  # what it refers to is looked at there
                continue
            value = _resolve(cfg, key)
        try:
            default = _resolve(shipped, key)
        except ValueError:
            default = None
        _check_value(key, value, default, entry_point, is_required=unresolved == "???")


def _resolve(cfg: DictConfig, key: str) -> Any:
    """Return a value as plain data; raises ValueError, which names the key, where what it refers to
    is not there.
    """
    try:
        found = OmegaConf.select(cfg, key, throw_on_missing=False)
    except OmegaConfBaseException as error:
        raise ValueError(f"{key}: {error}") from error
    return OmegaConf.to_container(found, resolve=False) if OmegaConf.is_config(found) else found


def _shipped_config() -> DictConfig | None:
    """Return the config of this job with its choices of groups but no other override; None where
    nothing can be composed.
    """
    if not GlobalHydra.instance().is_initialized():
        return None
    job, loader = HydraConfig.get(), GlobalHydra.instance().config_loader()
    parser = OverridesParser.create()
    given = [(line, parser.parse_override(line).key_or_group) for line in job.overrides.task]
    chosen = [line for line, group in given if loader.get_group_options(group)]
    shipped = loader.load_configuration(job.job.config_name, chosen, RunMode.RUN)
    OmegaConf.set_struct(shipped, False)
    shipped.pop("hydra", None)
    return shipped


def _at(node: Any, key: str) -> Any:
    """Return what nested dicts hold at a dotted key, None where they do not."""
    for name in key.split("."):
        node = node.get(name) if isinstance(node, dict) else None
    return node


def _walk(given: dict, shipped: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted key, value) of what both have as mappings, and of all below these."""
    for name, value in given.items():
        key, default = f"{prefix}{name}", shipped.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            yield from _walk(value, default, f"{key}.")
        else:
            yield key, value


def _is_known(key: str, value: Any, given: dict, shipped: dict) -> bool:
    """Return whether the shipped config has the key, or it may be added: an argument of a class
    (_target_), an entry of OPEN.
    """
    *parents, name = key.split(".")
    for parent in parents:
        given, shipped = given[parent], shipped[parent]
        if "_target_" in given:
            return True
    is_part = isinstance(value, dict) and "_target_" in value
    return name in shipped or is_part or ".".join(parents) in OPEN


def _check_value(key: str, value: Any, default: Any, entry_point: str, is_required: bool) -> None:
    kinds = KINDS.get(key) or KINDS.get(f"{entry_point}:{key}")
    if kinds is None and is_path_key(key, entry_point):
        may_be_null = default is None and not is_required
        kinds = (WORD, *([NULL] * may_be_null), *([LIST] * key.startswith(RANGES)))
    kinds = kinds or _kinds_like(key, default)
    if kinds and value != "???" and not _is_of(value, kinds):
        got = NULL if value is None else value
        raise ValueError(f"{key} must be {' or '.join(kinds)}, got {got}")
    if is_required and value == "":
        raise ValueError(f"{key} must be a word, got none")
    if key in CHOICES and value not in CHOICES[key]:
        raise ValueError(f"{key} must be {' or '.join(CHOICES[key])}, got {value}")
    least, most = BOUNDS.get(key, (-math.inf, math.inf))
    if type(value) is int and not least <= value <= most:
        allowed = f">= {least}" if most == math.inf else f"in {least}..{most}"
        raise ValueError(f"{key} must be {allowed}, got {value}")
    if key in SIZES and value is not None and not _is_size(value):
        wanted = f"[height,width], whole numbers in 1..{LARGEST_SIDE}"
        raise ValueError(f"{key} must be {wanted}, got {value}")


def _kinds_like(key: str, default: Any) -> tuple[str, ...]:
    """Return the kinds that a key takes whose shipped value is `default`; none: any."""
    if default is None or default == "???":
        return ()
    kind = next(kind for kind in (FLAG, NUMBER, WORD, LIST, MAPPING) if _is_of(default, (kind,)))
    if kind in (NUMBER, LIST) and key.startswith(RANGES):
        return (NUMBER, LIST, NULL)
    if kind == MAPPING or key.startswith(RANGES):
        return (kind, NULL)
    return (kind,)


def _is_size(value: list) -> bool:
    return len(value) == 2 and {*map(type, value)} == {int} and are_sensor_sides(value)


def _is_of(value: Any, kinds: tuple[str, ...]) -> bool:
    types: dict[str, tuple[type, ...]] = {
        NUMBER: (int, float), WHOLE: (int,), WORD: (str,), FLAG: (bool,), LIST: (list, tuple),
        MAPPING: (dict,), NULL: (type(None),),
    }  # fmt: skip
    if isinstance(value, bool):
        return FLAG in kinds
    return any(isinstance(value, types[kind]) for kind in kinds)
