"""The weights that a training begins from, and the networks that it is compared with at its end."""

import warnings
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from src.app import entry_point, methods
from src.app.instantiate import as_dict
from src.models import files
from src.models.checkpoints import newest_checkpoint
from src.models.network import VideoMethod
from src.records import safe_yaml


def set_model_from_start_weights(cfg: DictConfig) -> Path | None:
    """Return the file that `start` names, None for a training from nothing, and make `cfg.model`
    its network: width, stem and all that follows from the weights.

    Where `ckpt` goes on, the `start` of budget=fine_tuning gives way to what `ckpt` began from; one
    that is typed stays.  An E2VID on one view is given those of `optics`.  Raises ValueError for a
    file that is not there or holds weights of another class, number of bins or number of views.
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
        kwargs["views"] = views
    OmegaConf.update(cfg, "model", {"_target_": got, **kwargs}, merge=False)
    return path


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
