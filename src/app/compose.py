"""Configs made without a command line."""

from collections.abc import Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.app import console
from src.app.config_files import CONF, config_choices
from src.app.config_values import check_values_like
from src.app.path_overrides import quote_paths, refuse_empty_paths
from src.app.renamed_keys import explain_refused_key, flatten_keys, refuse_renamed_keys
from src.records.overrides import read_override_key


def compose_config(name: str, *overrides: str) -> DictConfig:
    """Return conf/<name>.yaml with overrides, also inside an application of Hydra.

    Raises ValueError for a key or a choice that is none.
    """
    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(CONF, version_base=None):
            return compose(name, list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(describe_config_error(error, name)) from None
    finally:
        GlobalHydra.instance().hydra = outer


def compose_checked_config(
    name: str, chosen: Sequence[str], overrides: Sequence[str]
) -> DictConfig:
    """Return conf/<name>.yaml with `chosen` and with `overrides`, which are quoted and checked as
    those of a command line.

    Raises ValueError for a key or a choice that is none and for a value of another kind.
    """
    refuse_empty_paths(overrides, name)
    lines = [*chosen, *quote_paths(overrides, name)]
    cfg = compose_config(name, *lines)
    refuse_renamed_keys(cfg)
    groups = [line for line in lines if config_choices(read_override_key(line))]
    shipped = compose_config(name, *groups)
    OmegaConf.set_struct(shipped, False)
    check_values_like(cfg, shipped, name)
    return cfg


def describe_config_error(error: Exception, name: str) -> str:
    """Return in one line what is wrong with the overrides of conf/<name>.yaml, without the folders
    that Hydra has searched; of what a worker of a DataLoader raised its last line."""
    message = console.cut_worker_traceback(str(error))
    explained = explain_refused_key(message, _list_keys(name) if "Could not" in message else ())
    return " ".join((explained or message.partition("Config search path:")[0]).split())


def _list_keys(name: str) -> list[str]:
    """Return the groups, and the keys of conf/<name>.yaml where there is one."""
    groups = [folder.name for folder in Path(CONF).iterdir() if folder.is_dir()]
    if not (Path(CONF) / f"{name}.yaml").is_file():
        return groups
    return [*groups, *flatten_keys(OmegaConf.to_container(compose_config(name), resolve=False))]
