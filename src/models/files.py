"""Networks on disk: shipped weights (safetensors) and training checkpoints (.ckpt).

A file says which network it holds: {"target": "src.models.e2vid.E2VID", "kwargs": {...}}.  Nothing
in a file is executed: only classes of `src.models` and `baselines` are built, from plain values.
"""

import json
import os
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.utils import parametrize

from src import COMMAND, add_package_prefix
from src.models.checkpoints import is_intact, newest_checkpoint
from src.models.e2vid import E2VID
from src.models.folding import fold_parametrizations, inference_copy
from src.models.size_limit import MAX_SIZE
from src.records.atomic import atomic_path

WEIGHTS = Path(__file__).resolve().parents[2] / "weights"
PACKAGES = ("src.models.", "baselines.")
WIDENABLE = "src.models.e2vid.E2VID"  # goes on from its weights on one view
POWER_ITERATIONS = 50


def load(name_or_path: str | Path, allowed_packages: Sequence[str] = ()) -> nn.Module:
    """Return the network of a file, float32, in eval mode, spectral norm folded into its weights.

    A name of `weights/` is that file, else it is a path (./name, where there is one of that name):
    a `.safetensors` file written by `save`, a checkpoint of a training run or its folder.  Its
    network is of src.models, baselines or a package of `allowed_packages`.  Raises ValueError,
    beginning with `ckpt`, for a file that is not there, is no such file, or holds other weights
    than its network has.
    """
    is_path = isinstance(name_or_path, str | os.PathLike)
    path = locate(name_or_path) if is_path else Path()
    if is_path and path.is_dir():
        path = newest_checkpoint(path)
    if not path.is_file():
        where = f"weights/ ({list_shipped()})"
        raise ValueError(f"ckpt must be a file or one of {where}, got {name_or_path}")
    spec, weights = (_exported if is_weights_file(path) else _checkpoint)(path)[:2]
    check_weights_stored_whole(weights, path, "ckpt")
    with torch.device("meta"):  # without memory: a small file may name a huge network
        empty = _build(spec, path, allowed_packages)
    check_weights_fit(
        f"ckpt does not fit {type(empty).__name__} in {path}", empty.state_dict(), weights
    )
    with torch.random.fork_rng(devices=[]):  # it begins with random weights
        network = _build(spec, path, allowed_packages)
    network.load_state_dict(weights)
    fold_parametrizations(network)
    return network.float().eval()


def locate(name: str | Path) -> Path:
    """Return the shipped file where `name` is one of `list_shipped`, else the path `name`.

    The shipped one comes first: a file or folder of that name in this folder is "./name", a string,
    as a Path drops "./".
    """
    path, shipped = Path(name), WEIGHTS / f"{name}.safetensors"
    may_be_shipped = not (path.is_absolute() or ".." in path.parts or str(path) != str(name))
    return shipped if may_be_shipped and os.path.isfile(shipped) else path


def list_shipped() -> str:
    """Return the names in `weights/`, those of its folders last, for a message."""
    paths = (file.relative_to(WEIGHTS) for file in WEIGHTS.rglob("*.safetensors"))
    names = (path.with_suffix("").as_posix() for path in paths)
    return ", ".join(sorted(names, key=lambda name: (name.count("/"), name))) or "none yet"


def find_checkpoint(name: str | Path, spec: dict) -> Path:
    """Return the file to go on from: that of `locate(name)`, of a folder its newest whole
    checkpoint.

    Raises ValueError unless it is a whole checkpoint, or a file of `save`, of the network `spec`;
    a file of `save` may also be of the same E2VID on one view.
    """
    path = locate(name)
    is_shipped = path != Path(name)
    path = newest_checkpoint(path) if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"ckpt must be a checkpoint to go on from, got {name}")
    saved, _ = (_exported if is_weights_file(path) else _checkpoint)(path)[:2]
    wanted = [spec]
    if is_weights_file(path):
        kwargs = spec["kwargs"] | _without_spectral_norm(spec)
        one_view = {"views": 1} if spec["target"] == WIDENABLE else {}
        wanted = [spec | {"kwargs": kwargs | more} for more in ({}, one_view)]
    if saved not in wanted:
        if is_shipped:
            how = f"experiment={name} and the overrides of conf/recipe/{name}.yaml"
            here = f"; what is here of that name is ckpt=./{name}" if Path(name).exists() else ""
            raise ValueError(
                f"ckpt={name} must be of the network that is trained; go on with {how}{here}"
            )
        raise ValueError(f"ckpt must be of the network {spec} to go on from, got {saved} in {path}")
    return path


def is_weights_file(path: Path) -> bool:
    """Return whether `path` is a file of `save`, without the state of an optimiser."""
    return path.suffix == ".safetensors"


def read_card(path: Path) -> dict:
    """Return what `save` was given beside the weights of the file `path`; ValueError as `load`."""
    return _exported(path)[2]


def read_network_spec(path: Path) -> dict:
    """Return `target` and `kwargs` of the network of a file of `save`; ValueError as `load`."""
    return _exported(path)[0]


@torch.no_grad()
def restore_weights(network: nn.Module, path: Path) -> None:
    """Give `network` the weights of a file of `save`; spectral norms find their vectors anew.

    An E2VID on many views takes those of one view too (E2VID.widen_state_dict).  Raises ValueError,
    beginning with `ckpt`, for the weights of another network.
    """
    spec, weights, _ = _exported(path)
    if isinstance(network, E2VID) and spec["kwargs"].get("views", 1) == 1:
        weights = network.widen_state_dict(weights)
    own = inference_copy(network).state_dict()
    check_weights_fit(f"ckpt does not fit {type(network).__name__} in {path}", own, weights)
    for prefix, module in network.named_modules():
        if parametrize.is_parametrized(module, "weight"):
            module.weight = weights.pop(f"{prefix}.weight")
            module.train()
            for _ in range(POWER_ITERATIONS):
                module.weight  # noqa: B018  every look is an iteration
    network.load_state_dict(weights, strict=False)


def save(path: Path, network: nn.Module, spec: dict, card: dict) -> None:
    """Write `network`, spectral norm folded, as float16 safetensors with `spec` and `card` (plain
    values: data, seeds, commit, metrics ...) in its header; whole or not at all.
    """
    spec = {"target": spec["target"], "kwargs": spec["kwargs"] | _without_spectral_norm(spec)}
    plain = _build(spec, path, [type(network).__module__])
    plain.load_state_dict(inference_copy(network).state_dict())
    halves = {
        name: (value.half() if value.is_floating_point() else value).contiguous()
        for name, value in plain.state_dict().items()
    }
    with atomic_path(path) as partial:
        save_file(halves, partial, {"network": json.dumps(spec), "card": json.dumps(card)})


def _without_spectral_norm(spec: dict) -> dict:
    return {"spectral_norm": False} if "spectral_norm" in spec["kwargs"] else {}


def _exported(path: Path) -> tuple[dict, dict[str, Tensor], dict]:
    """Return `target` and `kwargs` of the network of a file of `save`, its weights and its card."""
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata()
            weights = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
        return json.loads(header["network"]), weights, json.loads(header["card"])
    except Exception as error:  # libraries raise all kinds on a broken file
        raise ValueError(f"ckpt must be a network written by this project, got {path}") from error


def _checkpoint(path: Path) -> tuple[dict, dict[str, Tensor]]:
    if not is_intact(path):
        raise ValueError(f"ckpt must be a checkpoint of `{COMMAND}train` that is whole, got {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        state = content["state_dict"]
        weights = {n.removeprefix("network."): v for n, v in state.items() if "network." in n}
        return content["network"], weights
    except Exception as error:  # libraries raise all kinds on a broken file
        raise ValueError(f"ckpt must be a checkpoint of `{COMMAND}train`, got {path}") from error


def _build(spec: dict, path: Path, allowed_packages: Sequence[str] = ()) -> nn.Module:
    try:
        target, kwargs = str(spec["target"]), dict(spec["kwargs"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"ckpt must name its network, got {path}") from error
    homes = (*PACKAGES, *(f"{package}." for package in allowed_packages))
    if not target.startswith(homes):
        raise ValueError(
            f"ckpt must hold a network of {' or '.join(homes)}, got {target} in {path}; "
            "networks of a package of your own are let in by allowed_packages=[<package>]"
        )
    check_sizes(target, kwargs, "ckpt", f" in {path}")
    module, _, name = target.rpartition(".")
    try:
        kind = getattr(import_module(add_package_prefix(module)), name)
        if not issubclass(kind, nn.Module):
            raise TypeError(f"{target} is no network")
        return kind(**kwargs)
    except Exception as error:  # networks raise all kinds for arguments that are not theirs
        wanted = f"{target} of {kwargs}"
        raise ValueError(f"ckpt names a network that is not here: {wanted} in {path}") from error


def check_sizes(target: str, value: Any, key: str, where: str = "") -> None:
    """Raise ValueError, beginning with `key`, for a number beyond MAX_SIZE in `value`, arguments of
    the network `target`: it would fill the memory.  Those of other classes than PACKAGES' may be
    any."""
    if not target.startswith(PACKAGES):
        return
    if isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            check_sizes(target, part, key, where)
    elif isinstance(value, int | float) and not abs(value) <= MAX_SIZE:
        raise ValueError(f"{key} must hold sizes up to {MAX_SIZE}, got {value}{where}")


def check_weights_stored_whole(weights: dict[str, Tensor], path: Path, key: str) -> None:
    """Raise ValueError, beginning with `key`, for weights of more numbers than the file has bytes:
    in a view of a few numbers any size fits, but the network made for it has to hold them all.
    """
    numbers, size = sum(value.numel() for value in weights.values()), path.stat().st_size
    if numbers > size:
        got = f"{numbers} numbers in {size} bytes of {path}"
        raise ValueError(f"{key} must hold its weights whole, got {got}")


def check_weights_fit(error: str, own: dict[str, Tensor], weights: dict[str, Tensor]) -> None:
    """Raise ValueError, beginning with `error`, unless names and shapes are those of `own`."""
    missing, extra = sorted(own.keys() - weights.keys()), sorted(weights.keys() - own.keys())
    other = sorted(n for n in own.keys() & weights.keys() if own[n].shape != weights[n].shape)
    if missing or extra or other:
        raise ValueError(f"{error}: missing {missing}, extra {extra}, of another shape {other}")
