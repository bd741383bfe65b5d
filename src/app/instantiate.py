"""Objects from config nodes: which classes a config may name, and what is required of them.

`hydra.utils.instantiate` is called nowhere else.
"""

import re
from collections.abc import Sequence
from typing import Any, Protocol, cast

from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf

from baselines.published import load_pretrained
from src import HOME, add_package_prefix
from src.models.network import EventToVideoNetwork, FramePostprocessor, VideoMethod
from src.models.setnet import SetNet
from src.sim.scenes.clip import Scene
from src.sim.sensor.sensor import Sensor
from src.sim.turbulence.contract import TurbulenceModel

FACTORIES = (load_pretrained, SetNet.preset)  # no classes, allowed all the same
FUNCTIONS = "src.bench.stress_tests."  # whose functions are allowed too
PACKAGE_NAME = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*"
ALLOWED_PACKAGES = (
    "src.", "baselines.", "torch.optim.", "lightning.pytorch.trainer.",
    *(f"lightning.pytorch.{name}." for name in ("callbacks", "loggers", "plugins", "profilers")),
)  # fmt: skip


CONTRACTS: dict[str, tuple[type, ...]] = {  # key of the config: what its object must be one of
    "scene": (Scene,),
    "turbulence": (TurbulenceModel,),
    "sensor": (Sensor,),
    "model": (EventToVideoNetwork, FramePostprocessor),
    "baseline": (VideoMethod,),
}


def read_user_packages(cfg: DictConfig) -> tuple[str, ...]:
    """Return the user's packages whose classes this config may name too.

    Raises ValueError for an `allowed_packages` that is no list of package names.
    """
    names = cfg.get("allowed_packages") or []
    if isinstance(names, str) or not all(re.fullmatch(PACKAGE_NAME, str(name)) for name in names):
        example = "a list of packages such as [mypackage]"
        raise ValueError(f"allowed_packages must be {example}, got {names}")
    return tuple(names)


def build_part(cfg: DictConfig, key: str, **kwargs) -> Any:
    """Build the object of the config node `key`; `kwargs` are added to the node's values.

    Raises ValueError as `instantiate_node` does, and for a class that lacks what `key` needs.
    """
    node = OmegaConf.select(cfg, key)
    return check_contract(key, instantiate_node(node, read_user_packages(cfg), **kwargs))


def as_dict(node: Any) -> dict[str, Any]:
    """Return a mapping of the config as nested dicts, interpolations resolved."""
    return cast(dict[str, Any], OmegaConf.to_container(node, resolve=True))


def check_contract(key: str, built: Any) -> Any:
    """Return `built`, the object of the config node `key`; raises ValueError, with the members that
    are missing, unless it is what CONTRACTS asks for.
    """
    contracts = CONTRACTS.get(key, (object,))
    if not isinstance(built, contracts):
        names = " or ".join(f"{c.__module__}.{c.__name__}" for c in contracts)
        members = {*vars(contracts[0]), *getattr(contracts[0], "__annotations__", ())}
        public = sorted(n for n in members - set(vars(Protocol)) if n[0] != "_")
        missing = ", ".join(name for name in public if not hasattr(built, name))
        kind = f"{type(built).__module__}.{type(built).__name__}"
        lacks = f" (it has no {missing})" if missing else ""
        raise ValueError(f"{key}._target_ must be a {names}, got {kind}{lacks}")
    return built


def instantiate_node(node: Any, extra_packages: Sequence[str] = (), **kwargs) -> Any:
    """Instantiate a config node.

    Raises ValueError for a `_target_`, however deep, that is no class of ALLOWED_PACKAGES or of
    the user's `extra_packages`; a ValueError of the object itself is not wrapped by Hydra.
    """
    plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    if not isinstance(plain, dict) or "_target_" not in plain:
        raise ValueError(f"a part of the config must name its class (_target_), got {plain}")
    named = _import_targets(plain, extra_packages)
    try:
        return instantiate(named, _convert_="all", **kwargs)
    except InstantiationException as error:
        if isinstance(error.__cause__, ValueError):
            raise error.__cause__ from None
        raise ValueError(f"{plain['_target_']} takes no such values: {error.__cause__}") from error


def _import_targets(node: Any, packages: Sequence[str]) -> Any:
    """Return nested dicts and lists with every `_target_`, once checked, as it is imported."""
    if isinstance(node, dict):
        named = {name: _import_targets(value, packages) for name, value in node.items()}
        if "_target_" in node:
            named["_target_"] = _check_target(str(node["_target_"]), packages)
        return named
    return [_import_targets(value, packages) for value in node] if isinstance(node, list) else node


def _check_target(target: str, packages: Sequence[str]) -> str:
    """Return the name to import; raises ValueError unless it is a class of an allowed package.

    A name alone says little: `torch.optim.adam.torch.load` begins like an optimiser.
    """
    own = tuple(f"{package}." for package in packages)
    refusal = (
        f"_target_ must be a class of {', '.join(ALLOWED_PACKAGES + own)}, got {target}; "
        "classes of a package of your own are allowed by allowed_packages=[<package>]"
    )
    if not target.startswith(("src.", "baselines.", "torch.optim.", "lightning.", *own)):
        raise ValueError(refusal)
    try:
        named = get_object(imported := add_package_prefix(target))
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"_target_ must name a class, got {target}") from error
    module = f"{getattr(named, '__module__', '')}.".removeprefix(HOME)
    defined_here = isinstance(named, type) and module.startswith(ALLOWED_PACKAGES + own)
    if named not in FACTORIES and not defined_here and not module.startswith(FUNCTIONS):
        raise ValueError(refusal)
    return imported
