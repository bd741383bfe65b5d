"""The weights that a training begins from, and the networks that it is compared with at its end."""

import sys
import warnings
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from src.app import build, entry_point, methods
from src.app.instantiate import as_dict
from src.models import files
from src.models.checkpoints import newest_checkpoint
from src.models.e2vid import E2VID
from src.models.network import VideoMethod
from src.records import safe_yaml
from src.reports.clip_conditions import format_setting

UNIT_NORM_TOLERANCE = 0.05  # of gates trained with spectral norm, whose estimate lags behind


def set_model_from_start_weights(cfg: DictConfig) -> Path | None:
    """Return the file that `start` names, None for a training from nothing, and make `cfg.model`
    its network: width, stem and all that follows from the weights.  `model.spectral_norm`, which
    files hold folded, stays where the gates have norm one, and where it is typed.

    Where `ckpt` goes on, the `start` of budget=fine_tuning gives way to what `ckpt` began from; one
    that is typed stays.  An E2VID on one view is given those of `optics`.  Raises ValueError for a
    file that is not there or holds weights of another class, number of bins or number of views,
    and for other values of the network that are typed.
    """
    if (
        cfg.start not in (None, "none")
        and cfg.ckpt
        and not entry_point.is_set_on_command_line("start")
    ):
        cfg.start = _find_start_of(cfg.ckpt)
    if cfg.start in (None, "none"):
        return None
    path = files.locate(cfg.start)
    if not path.is_file() or not files.is_weights_file(path):
        where = f"weights/ ({files.list_shipped()})"
        raise ValueError(f"start must be none, one of {where} or a file, got {cfg.start}")
    try:
        spec = files.read_network_spec(path)
    except ValueError as error:
        raise ValueError(f"start must be weights to begin from: {error}") from error
    wanted, got = cfg.model._target_.removesuffix(".preset"), spec["target"]
    if got != wanted:
        raise ValueError(f"start must be weights of {wanted}, got {got} in {path}")
    kwargs = dict(spec["kwargs"])
    if kwargs.get("bins", cfg.bins) != cfg.bins:
        raise ValueError(f"start must be weights for bins={cfg.bins}, got {kwargs['bins']}")
    if got == files.WIDENABLE:
        views = cfg.optics.views
        if kwargs.get("views", 1) not in (1, views):
            raise ValueError(f"start must be weights of 1 or {views} views, got {kwargs['views']}")
        kwargs |= {"views": views, "spectral_norm": _choose_spectral_norm(cfg, path)}
    _refuse_other_typed_values(cfg, kwargs)
    OmegaConf.update(cfg, "model", {"_target_": got, **kwargs}, merge=False)
    return path


@torch.no_grad()
def _choose_spectral_norm(cfg: DictConfig, path: Path) -> bool:
    """Return `model.spectral_norm` for the training; False, with a line, for gates of another norm
    than one in the file `path` of an E2VID, unless it is typed."""
    if not cfg.model.get("spectral_norm"):
        return False
    if entry_point.is_set_on_command_line("model.spectral_norm"):
        return True
    network = files.load(path)
    assert isinstance(network, E2VID)
    norms = [float(torch.linalg.matrix_norm(gate.weight.flatten(1), 2)) for gate in network.gates]
    unlike = max(norms, key=lambda norm: abs(norm - 1))
    if abs(unlike - 1) <= UNIT_NORM_TOLERANCE:
        return True
    print(f"start has gates of norm {unlike:.3g}: model.spectral_norm=false", file=sys.stderr)
    return False


def _refuse_other_typed_values(cfg: DictConfig, kwargs: dict[str, Any]) -> None:
    """Raise ValueError for a key of `model`, or one that it follows, that the command line sets to
    another value than the network of `start` has, which `kwargs` build."""
    for name, value in as_dict(cfg.model).items():
        key = _find_typed_key(cfg, name)
        if key is None or name == "_target_":
            continue
        if name not in kwargs:
            _refuse_other_preset(cfg, key, kwargs)
        elif value != kwargs[name]:
            wanted = f"{format_setting(kwargs[name])}, as in start={cfg.start}"
            raise ValueError(f"{key} must be {wanted}, got {format_setting(value)}")


def _refuse_other_preset(cfg: DictConfig, key: str, kwargs: dict[str, Any]) -> None:
    """Raise ValueError for a preset, set by `key`, whose network is not that of `kwargs`."""
    built = _network_arguments(cfg)
    other = [name for name in kwargs if built.get(name) != kwargs[name]]
    if other:
        wanted, got = (
            ", ".join(f"{name}={format_setting(values.get(name))}" for name in other)
            for values in (kwargs, built)
        )
        raise ValueError(f"{key} must have {wanted}, as in start={cfg.start}, got {got}")


def _find_typed_key(cfg: DictConfig, name: str) -> str | None:
    """Return the key on the command line that sets the argument `name` of `model`: its own, that of
    `${...}`, the choice of a preset; None without one."""
    written = OmegaConf.to_container(cfg.model, resolve=False)
    assert isinstance(written, dict)
    keys = [f"model.{name}", str(written[name]).removeprefix("${").removesuffix("}")]
    keys += ["model"] if cfg.model._target_.endswith(".preset") else []
    return next((key for key in keys if entry_point.is_set_on_command_line(key)), None)


def _network_arguments(cfg: DictConfig) -> dict[str, Any]:
    with torch.random.fork_rng(devices=[]):  # it begins with random weights
        return build.build_untrained_network(cfg)[1]["kwargs"]


def _find_start_of(ckpt: str) -> str:
    """Return the `start` of the run of `ckpt`, none of one without a config; of a file of weights
    the file itself."""
    path = files.locate(ckpt)
    if files.is_weights_file(path):
        return ckpt
    path = newest_checkpoint(path) if path.is_dir() else path
    config = path.parent.parent / "config.yaml"
    stored = safe_yaml.read(config) if config.is_file() else {}
    return stored.get("start") or "none"


def label_before_training(cfg: DictConfig, path: Path | None) -> str:
    """Return what the table calls the network before its training."""
    if path is None:
        return "untrained"
    before = files.read_network_spec(path)["kwargs"].get("views")
    given = f" given {cfg.optics.views} views" if before == 1 != cfg.optics.views else ""
    return f"{cfg.start}{given}, before training"


def load_reference_networks(cfg: DictConfig) -> dict[str, VideoMethod]:
    """Return the networks of `references` by their names in the table; those that take other views
    than `optics` has are left out with a warning.

    Raises ValueError, naming the key, for one that cannot be loaded.
    """
    networks, views = {}, cfg.optics.views
    for name, weights in as_dict(cfg.references).items():
        prefix = f"references.{name} must be a network"
        network = methods.load_network_of_kind(VideoMethod, cfg, weights, prefix)
        if network.views not in (None, views):
            wanted = f"optics.views={network.views}, got {views}"
            warnings.warn(f"references.{name} is left out: it takes {wanted}", stacklevel=2)
            continue
        networks[name] = network
    return networks
