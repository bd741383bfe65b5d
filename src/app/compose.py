"""The folder of the configs, and configs made without a command line."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

CONF = str(Path(__file__).resolve().parents[2] / "conf")


def config_choices(group: str) -> list[str]:
    """Return the names of the configs of a group such as turbulence."""
    return sorted(file.stem for file in (Path(CONF) / group).glob("*.yaml"))


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
        raise ValueError(" ".join(str(error).split())) from None
    finally:
        GlobalHydra.instance().hydra = outer
