"""The plan of a time-limited training, and whether it fits its minutes and megabytes."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.models import files
from src.sim.scenes import photo_pack
from src.training.handover import reached

CONF = Path(__file__).resolve().parents[2] / "conf"
MIB = 2**20
LEAST_RATE = 0.02  # over the optimiser's, at which a training that goes on begins


@dataclass(frozen=True)
class Network:
    """One training: `minutes` of it at least, and of the minutes that are left over in proportion
    to `share`; `optional`: only where it fits.  `start`: weights to go on from, with their hours,
    `restart` the cosine of the rate at its beginning all the same.
    """

    name: str
    experiment: str = ""
    minutes: float = 0.0
    share: float = 0.0
    optional: bool = False
    overrides: Sequence[str] = ()
    start: str | None = None
    restart: bool = False

    def __post_init__(self):
        if not re.fullmatch(r"[A-Za-z0-9_-]+", str(self.name)):  # it names files
            raise ValueError(f"networks: name must be letters, digits, _ and -, got {self.name}")
        for key in ("minutes", "share"):
            _check(f"networks: {key} of {self.name}", getattr(self, key), least=0)
        if not self.minutes and (self.optional or not self.share):
            raise ValueError(f"networks: minutes of {self.name} must be > 0, got {self.minutes}")


@dataclass(frozen=True)
class Fill:
    """How long each pre-simulated cache is filled, the clips it is filled with at most, those with
    which training is worth while, and the processes that draw scenes beside (None: as many as
    there are cores but one, 15 at most).
    """

    minutes: float
    clips: int
    least: int = 16
    workers: int | None = None

    def __post_init__(self):
        _check("fill: minutes", self.minutes, above=0)
        _check("fill: least", self.least, least=1, kind=int)
        _check("fill: clips", self.clips, least=self.least, kind=int)
        if self.workers is not None:
            _check("fill: workers", self.workers, least=0, kind=int)


@dataclass(frozen=True)
class Validate:
    """Validation clips, how often they are scored after the start, and the seconds of each
    network that this may take."""

    clips: int = 8
    times: int = 4
    seconds: float = 20.0

    def __post_init__(self):
        _check("validate: clips", self.clips, least=1, kind=int)
        _check("validate: times", self.times, least=1, kind=int)
        _check("validate: seconds", self.seconds, above=0)


@dataclass(frozen=True)
class Plan:
    """What conf/lease/default.yaml explains; paths are relative to `folder`, that of the file."""

    folder: Path
    networks: Sequence[Network]
    fill: Fill
    validate: Validate = field(default_factory=Validate)
    common: Sequence[str] = ()
    scenes: str | None = None
    lpips: str | None = None
    check_s: float = 60.0
    export_s: float = 60.0
    margin_s: float = 40.0
    budget_mib: float = 64.0
    file_mib: float = 16.0
    files: int = 8

    def __post_init__(self):
        for key in ("check_s", "export_s", "margin_s", "budget_mib", "file_mib"):
            _check(key, getattr(self, key), above=0)
        _check("files", self.files, least=3, kind=int)
        names = [network.name for network in self.networks]
        if len(set(names)) < len(names) or not names:
            raise ValueError(f"networks must have names of their own, got {', '.join(names)}")

    def path(self, name: str) -> Path:
        """Return the file of the plan's folder that is called `name`."""
        return (self.folder / name).resolve()

    def only(self, names: Sequence[str]) -> "Plan":
        """Return the plan with these networks; ValueError for a name that is none of them."""
        known = [network.name for network in self.networks]
        if unknown := [name for name in names if name not in known]:
            raise ValueError(f"only must be of {', '.join(known)}, got {', '.join(unknown)}")
        chosen = [network for network in self.networks if network.name in names]
        return dataclasses.replace(self, networks=chosen)

    def given(self, network: Network) -> list[str]:
        """Return the overrides of src.train that make the config of `network`."""
        experiment = network.experiment or network.name
        return [f"experiment={experiment}", *self.common, *network.overrides]

    def config(self, network: Network) -> DictConfig:
        """Return the config that `network` is trained with; hours and folder are not in it yet.

        Raises the exceptions of Hydra and OmegaConf where it is none.
        """
        with initialize_config_dir(str(CONF), version_base=None):
            cfg = compose("train", self.given(network))
        cfg.data.val_clips = self.validate.clips
        if cfg.data.bank is not None:
            cfg.data.bank = self.fill.clips
        if self.scenes is not None:
            cfg.scene.root = str(self.path(self.scenes))
        if self.lpips is not None:
            for part in (cfg.loss, cfg.metrics.lpips):
                if part is not None and "LPIPS" in part._target_:
                    OmegaConf.update(part, "backbone", str(self.path(self.lpips)), force_add=True)
        return cfg

    def hours_before(self, network: Network) -> float:
        """Return the hours that the weights it goes on from have had."""
        return reached(self.path(network.start))["hours"] if network.start else 0.0


def load(path: Path) -> Plan:
    """Return the plan of a YAML file.

    Raises ValueError naming the key for what is no plan, or names a file that is not there or
    damaged.
    """
    try:
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OSError, OmegaConfBaseException, ValueError) as error:
        raise ValueError(f"{path} must be as conf/lease/default.yaml is: {error}") from error
    if not isinstance(content, Mapping) or not isinstance(content.get("networks"), list):
        raise ValueError(f"{path} must be as conf/lease/default.yaml is: networks are missing")
    networks = [_made(Network, row, "networks: ") for row in content.pop("networks")]
    parts = {"networks": networks, "folder": path.resolve().parent}
    for name, kind in (("fill", Fill), ("validate", Validate)):
        if name in content:
            parts[name] = _made(kind, content.pop(name), f"{name}: ")
    plan = _made(Plan, content | parts)
    for key, name in (("scenes", plan.scenes), ("lpips", plan.lpips)):
        if name is not None and not plan.path(name).exists():
            raise ValueError(f"{key} must be a file, got {name}, which is not in {plan.folder}")
    if plan.scenes is not None and plan.path(plan.scenes).is_file():
        photo_pack.check(plan.path(plan.scenes))
    for network in networks:
        if network.start is not None:
            _check_start(plan, network)
    return plan


def _check_start(plan: Plan, network: Network) -> None:
    path = plan.path(network.start)
    if not files.exported(path) or not path.is_file():
        raise ValueError(f"networks: start of {network.name} must be exported weights, got {path}")
    hours = plan.hours_before(network)
    rate = (1 + math.cos(math.pi * hours / (hours + network.minutes / 60 or 1))) / 2
    if not network.restart and rate < LEAST_RATE:
        raise ValueError(
            f"networks: restart of {network.name} must be true: after {hours:.2f} h a cosine of "
            f"{network.minutes:g} minutes more begins at {rate:.2%} of the rate"
        )


def _made(kind: type, content: Any, where: str = "") -> Any:
    """Return the dataclass `kind` of plain values; ValueError naming unknown and missing keys."""
    fields = {each.name: each for each in dataclasses.fields(kind)}
    if not isinstance(content, Mapping):
        raise ValueError(f"{where}must be keys and values, got {content}")
    unknown = [str(key) for key in content if key not in fields]
    needed = [
        name
        for name, each in fields.items()
        if each.default is dataclasses.MISSING and each.default_factory is dataclasses.MISSING
    ]
    missing = [name for name in needed if name not in content]
    if unknown or missing:
        known = ", ".join(name for name in fields if name != "folder")
        wrong = [f"unknown {', '.join(unknown)}"] * bool(unknown)
        wrong += [f"missing {', '.join(missing)}"] * bool(missing)
        raise ValueError(f"{where}keys must be of {known}; {'; '.join(wrong)}")
    return kind(**content)


def _check(
    key: str,
    value: Any,
    *,
    least: float | None = None,
    above: float | None = None,
    kind: Any = None,
) -> None:
    wanted = kind or (int, float)
    right = isinstance(value, wanted) and not isinstance(value, bool)
    right = right and (least is None or value >= least) and (above is None or value > above)
    if not right:
        what = "a whole number" if kind is int else "a number"
        limit = f">= {least:g}" if above is None else f"> {above:g}"
        raise ValueError(f"{key} must be {what} {limit}, got {value}")
