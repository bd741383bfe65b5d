"""From a part of a config to the object it names; what a config may name is decided here.

`hydra.utils.instantiate` is called here only.
"""

import re
from collections.abc import Iterator, Sequence
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf

from baselines.upstream import from_config
from src.app.contracts import keeping
from src.models.setnet import SetNet

# What is no class and may be named all the same.
FACTORIES = (from_config, SetNet.preset)
PACKAGE = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*"
OLDER = {  # what a part is where none is named: runs before 0.2 named none
    "turbulence": "src.sim.turbulence.simulated.SimulatedAir",
    "sensor": "src.sim.sensor.sensor.EventSensor",
}
ROOMS = (
    "src.", "baselines.", "torch.optim.", "lightning.pytorch.trainer.",
    *(f"lightning.pytorch.{room}." for room in ("callbacks", "loggers", "plugins", "profilers")),
)  # fmt: skip


def rooms(cfg: DictConfig) -> tuple[str, ...]:
    """Return the packages of one's own, `rooms`, whose classes this config may name too.

    Raises ValueError for what is no list of names.
    """
    given = cfg.get("rooms") or []
    if isinstance(given, str) or not all(re.fullmatch(PACKAGE, str(name)) for name in given):
        raise ValueError(f"rooms must be a list of packages such as [mypackage], got {given}")
    return tuple(given)


def part(cfg: DictConfig, key: str, **kwargs) -> Any:
    """Return what the part `key` of the config names, made with its values and `kwargs`.

    Raises ValueError as `make` does, and for a class that does not keep the contract of the part.
    """
    node = OmegaConf.select(cfg, key)
    if key in OLDER and "_target_" not in node:
        node = OmegaConf.merge({"_target_": OLDER[key]}, node)
    return keeping(key, make(node, rooms(cfg), **kwargs))


def make(node: Any, own: Sequence[str] = (), **kwargs) -> Any:
    """Instantiate a config node; raises ValueError for a `_target_`, however deep, that is no class
    of our rooms or of one's `own` packages.

    A ValueError of the object itself comes through as it is, not wrapped by Hydra.
    """
    plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    if not isinstance(plain, dict) or "_target_" not in plain:
        raise ValueError(f"a part of the config must name its class (_target_), got {plain}")
    for target in _targets(plain):
        _check(target, own)
    try:
        return instantiate(node, _convert_="all", **kwargs)
    except InstantiationException as error:
        if isinstance(error.__cause__, ValueError):
            raise error.__cause__ from None
        raise ValueError(f"{plain['_target_']} takes no such values: {error.__cause__}") from error


def _targets(node: Any) -> Iterator[str]:
    """Yield every `_target_` in plain dicts and lists."""
    if isinstance(node, dict):
        yield from (str(value) for key, value in node.items() if key == "_target_")
    if isinstance(node, dict | list):
        for value in node.values() if isinstance(node, dict) else node:
            yield from _targets(value)


def _check(target: str, own: Sequence[str]) -> None:
    """Raise ValueError unless `target` is a class that was written in one of the rooms.

    A name alone says little: `torch.optim.adam.torch.load` begins like an optimiser.
    """
    packages = tuple(f"{package}." for package in own)
    refusal = (
        f"_target_ must be a class of {', '.join(ROOMS + packages)}, got {target}; "
        "classes of a package of your own are let in by rooms=[<package>]"
    )
    if not target.startswith(("src.", "baselines.", "torch.optim.", "lightning.", *packages)):
        raise ValueError(refusal)
    try:
        named = get_object(target)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"_target_ must name a class, got {target}") from error
    home = f"{getattr(named, '__module__', '')}."
    written_here = isinstance(named, type) and home.startswith(ROOMS + packages)
    if named not in FACTORIES and not written_here:
        raise ValueError(refusal)
