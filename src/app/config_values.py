"""The values of a configuration, checked against the shipped one before anything runs.

A value must be of the kind that the shipped config has there: number, word, true or false, list or
mapping.  What is null there, or may be of several kinds, is listed below.
"""

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

NUMBER, WHOLE, WORD, FLAG = "a number", "a whole number", "a word", "true or false"
LIST, MAPPING, NULL = "a list", "a mapping", "null"
KINDS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(
        ("noise_filter_s", "train_hours", "grad_clip_norm", "ema_decay", "state_rounding_step",
         "loss_spike_factor", "turbulence.wind_m_s", "turbulence.baseline_m",
         "callbacks.learning_curve.interval_h", "data.max_grid_s", "data.start_s", "data.end_s"),
        (NUMBER, NULL),
    ),
    **dict.fromkeys(
        ("data.clips", "data.cache_clips", "data.loss_pairs", "dots.fit_radius_px", "last", "stem",
         "longest_side_px"),
        (WHOLE, NULL),
    ),
    **dict.fromkeys(
        ("bins", "seed", "index", "clips", "processes", "port", "max_waiting_windows", "samples",
         "first", "air.max_frames", "dots.rows", "dots.cols", "data.batch_size", "data.test_seed",
         "data.batch_reuse", "data.epoch_clips", "data.windows", "data.substeps", "data.workers",
         "data.test_windows", "data.test_clips", "data.val_clips", "data.unscored_windows",
         "data.loss_from", "data.events_per_window", "optics.views", "width", "scene.height",
         "scene.width", "sample_clips"),
        (WHOLE,),
    ),
    **dict.fromkeys(("sensor_size", "resolution", "line", "circle", "spin"), (LIST, NULL)),
    **dict.fromkeys(("videos", "offered_networks", "allowed_origins"), (LIST,)),
    **dict.fromkeys(("teachers", "against", "chart:ckpt", "stress:ckpt"), (WORD, LIST, NULL)),
    "train:start": (WORD, NULL),
    "run": (WORD, LIST),
    "names": (LIST, NULL),
    "live:threads": (WHOLE,),
    **dict.fromkeys(
        ("calibrate:fps", "simulate:fps", "camera.tile_px", "white_level"), (NUMBER, NULL)
    ),
    "compare:still": (NUMBER, NULL),
    "data.rates": (LIST, NULL),
    "data.crop": (NUMBER, LIST, NULL),
    "data.test_crop": (NUMBER, NULL),
    **dict.fromkeys(
        ("data.test_set", "data.grid_edges", "data.output_normalisation"), (WORD, NULL)
    ),
    "window_length": (WORD, NULL),
    "form": (WORD, NULL),
    "cuda_graphs": (WORD, FLAG),
    "views_used": (WORD, WHOLE),
    "trainer.precision": (WORD, NUMBER, NULL),
    "trainer.devices": (NUMBER, WORD, LIST),
    "trainer.deterministic": (WORD, FLAG),
}  # fmt: skip
# Parts whose own classes check whether a number, a range of numbers or null does.
RANGES = ("augment.", "optics.", "own_sensor.", "scene.", "sensor.", "target.", "turbulence.")
SIZES = ("sensor_size", "resolution", "camera.sensor_size")  # [height, width]
# More entries do.
OPEN = ("callbacks", "logger", "loss", "networks", "references", "scene.parts", "stress_tests")


def check_values(cfg: DictConfig) -> None:
    """Raise ValueError for a value of another kind than its key's, and for a key that is none."""
    shipped = _shipped_config()
    entry_point = HydraConfig.get().job.name  # that of a sweep's config too
    if shipped is not None:
        given = OmegaConf.to_container(cfg, resolve=False)
        _check_mapping(cast(dict, given), shipped, entry_point, _Config(cfg))


class _Config:
    """A config whose interpolations are resolved where they can be."""

    def __init__(self, cfg: DictConfig):
        self.cfg = cfg

    def value(self, key: str) -> Any:
        """Return a value as plain data; raises ValueError, which names the key, where what it
        refers to is not there.
        """
        try:
            found = OmegaConf.select(self.cfg, key, throw_on_missing=False)
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
    chosen = []
    for line in job.overrides.task:
        group = parser.parse_override(line).key_or_group
        if loader.get_group_options(group):
            chosen.append(line)
    shipped = loader.load_configuration(job.job.config_name, chosen, RunMode.RUN)
    OmegaConf.set_struct(shipped, False)
    shipped.pop("hydra", None)
    return shipped


def _check_mapping(given: dict, shipped: DictConfig, entry_point: str, cfg: _Config) -> None:
    defaults, plain = _Config(shipped), OmegaConf.to_container(shipped, resolve=False)
    for key, value in _walk(given, cast(dict, plain)):
        if not _is_known(key, value, given, cast(dict, plain)):
            raise ValueError(describe_unknown_key(key, list(flatten_keys(plain))))
        if isinstance(value, str) and "${" in value:
            if value == _at(cast(dict, plain), key):  # what it refers to is looked at there
                continue
            value = cfg.value(key)
        try:
            default = defaults.value(key)
        except ValueError:
            default = None
        is_required = _at(cast(dict, plain), key) == "???"
        _check_value(key, value, default, entry_point, is_required)


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
    if key in SIZES and value is not None and not _is_size(value):
        raise ValueError(f"{key} must be [height,width], whole numbers >= 1, got {value}")


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
    return len(value) == 2 and all(type(side) is int and side >= 1 for side in value)


def _is_of(value: Any, kinds: tuple[str, ...]) -> bool:
    types: dict[str, tuple[type, ...]] = {
        NUMBER: (int, float), WHOLE: (int,), WORD: (str,), FLAG: (bool,), LIST: (list, tuple),
        MAPPING: (dict,), NULL: (type(None),),
    }  # fmt: skip
    if isinstance(value, bool):
        return FLAG in kinds
    return any(isinstance(value, types[kind]) for kind in kinds)
