"""The plan of a time-limited training: a file as conf/lease/default.yaml."""

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from scripts.pack_scenes import verify_pack
from src.app.compose import compose_config
from src.app.renamed_keys import refuse_renamed_keys
from src.models import files
from src.training.learning_curve import read_training_progress

MIB = 2**20


@dataclass
class Network:
    """One training: `minutes` of it at least, and of the minutes that are left over in proportion
    to `share`; `optional`: only where it fits.  `start`: weights to continue from, a file or the
    name of shipped ones, with their hours; the cosine of the learning rate begins anew.
    """

    name: str = MISSING
    experiment: str = ""
    minutes: float = 0.0
    share: float = 0.0
    optional: bool = False
    overrides: list[str] = field(default_factory=list)
    start: str | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", self.name):  # it names files
            raise ValueError(f"networks: name must be letters, digits, _ and -, got {self.name}")
        for key in ("minutes", "share"):
            _check(getattr(self, key) >= 0, f"networks: {key} of {self.name}", ">= 0", self)
        if not self.minutes and (self.optional or not self.share):
            raise ValueError(f"networks: minutes of {self.name} must be > 0, got {self.minutes}")


@dataclass
class Fill:
    """How long each pre-simulated cache is filled, the clips it is filled with at most, those with
    which training is worth while, and the processes that draw scenes (None: as many as there are
    cores but one, 15 at most; 0: none beside this one).  `renews`: with every batch that is
    simulated, a new clip of these processes takes the place of the oldest.
    """

    minutes: float = MISSING
    clips: int = MISSING
    warn_below_clips: int = 16
    workers: int | None = None
    renews: bool = True

    def __post_init__(self) -> None:
        _check(self.minutes > 0, "fill: minutes", "> 0", self)
        _check(self.warn_below_clips >= 1, "fill: warn_below_clips", ">= 1", self)
        _check(
            self.clips >= self.warn_below_clips, "fill: clips", f">= {self.warn_below_clips}", self
        )
        _check(self.workers is None or self.workers >= 0, "fill: workers", ">= 0", self)


@dataclass
class Validate:
    """Validation clips, how often they are scored after the start, and the seconds of each
    network that this may take."""

    clips: int = 8
    count: int = 4
    total_s: float = 20.0

    def __post_init__(self) -> None:
        for key in ("clips", "count", "total_s"):
            _check(getattr(self, key) > 0, f"validate: {key}", "> 0", self)


@dataclass
class Plan:
    """What conf/lease/default.yaml explains; paths are relative to `folder`, that of the file."""

    networks: list[Network] = MISSING
    fill: Fill = MISSING
    folder: Path = Path()
    validate: Validate = field(default_factory=Validate)
    common: list[str] = field(default_factory=list)
    scenes: str | None = None
    lpips: str | None = None
    check_s: float = 60.0
    export_interval_s: float = 60.0
    margin_s: float = 40.0
    max_export_total_mib: float = 64.0
    max_export_file_mib: float = 16.0
    max_export_files: int = 8

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if isinstance(value, float):  # seconds and MiB
                _check(value > 0, key, "> 0", self)
        _check(self.max_export_files >= 3, "max_export_files", ">= 3", self)
        names = [network.name for network in self.networks]
        if len(set(names)) < len(names) or not names:
            raise ValueError(f"networks must have names of their own, got {', '.join(names)}")

    def path(self, name: str) -> Path:
        """Return the file of the plan's folder that is called `name`."""
        return (self.folder / name).resolve()

    def select(self, names: Sequence[str]) -> "Plan":
        """Return the plan with these networks; ValueError for a name that is none of them."""
        known = [network.name for network in self.networks]
        if unknown := [name for name in names if name not in known]:
            raise ValueError(f"only must be of {', '.join(known)}, got {', '.join(unknown)}")
        networks = [network for network in self.networks if network.name in names]
        return dataclasses.replace(self, networks=networks)

    def overrides(self, network: Network) -> list[str]:
        """Return the overrides of src.train that make the config of `network`."""
        experiment = network.experiment or network.name
        return [f"experiment={experiment}", *self.common, *network.overrides]

    def config(self, network: Network) -> DictConfig:
        """Return the config that `network` is trained with; hours and folder are not in it yet.

        Raises ValueError where it is none, OmegaConfBaseException for a key that it lacks.
        """
        cfg = compose_config("train", *self.overrides(network))
        cfg.data.val_clips = self.validate.clips
        if cfg.data.cache_clips is not None:
            cfg.data.cache_clips = self.fill.clips
        if self.scenes is not None:
            cfg.scene.root = str(self.path(self.scenes))
        if self.lpips is not None:
            weights = str(self.path(self.lpips))
            for node in (cfg.loss.get("lpips"), cfg.metrics.lpips):
                if node is not None:
                    OmegaConf.update(node, "backbone_weights", weights, force_add=True)
        return cfg

    def earlier_hours(self, network: Network) -> float:
        """Return the hours that the weights it continues from were trained."""
        start = network.start
        return read_training_progress(start_path(self.folder, start))["hours"] if start else 0.0


def start_path(folder: Path, start: str) -> Path:
    """Return the file of weights that `start` names: in the plan's `folder`, else a shipped one."""
    path = (folder / start).resolve()
    return path if path.is_file() else files.locate(start)


def read_content(path: Path) -> DictConfig:
    """Return the keys of a YAML file; raises ValueError for a file that has none."""
    try:
        content = OmegaConf.load(path)
    except (OSError, OmegaConfBaseException, yaml.YAMLError) as error:
        raise ValueError(f"{path} must be as conf/lease/default.yaml is: {error}") from error
    if not isinstance(content, DictConfig):
        raise ValueError(f"{path} must be as conf/lease/default.yaml is, got a list")
    return content


def load_plan(path: Path) -> Plan:
    """Return the plan of a YAML file.

    Raises ValueError naming the key for what is no plan, or names a file that is missing or
    damaged.
    """
    given = read_content(path)
    try:
        refuse_renamed_keys(OmegaConf.create({"lease": given}))
        content = OmegaConf.merge(OmegaConf.structured(Plan), given)
        content.folder = path.resolve().parent
        plan = OmegaConf.to_object(content)
    except (OmegaConfBaseException, TypeError) as error:
        raise ValueError(f"{path} must be as conf/lease/default.yaml is: {error}") from error
    assert isinstance(plan, Plan)
    for key, name in (("scenes", plan.scenes), ("lpips", plan.lpips)):
        if name is not None and not plan.path(name).exists():
            raise ValueError(f"{key} must be a file, got {name}, which is not in {plan.folder}")
    if plan.scenes is not None and plan.path(plan.scenes).is_file():
        verify_pack(plan.path(plan.scenes))
    for network in plan.networks:
        if network.start is not None:
            start, name = start_path(plan.folder, network.start), network.name
            if not files.is_weights_file(start) or not start.is_file():
                raise ValueError(f"networks: start of {name} must be exported weights, got {start}")
            read_training_progress(start)
    return plan


def _check(is_valid: bool, key: str, allowed: str, values: Any) -> None:
    if not is_valid:
        got = getattr(values, key.split()[1 if ":" in key else 0])
        raise ValueError(f"{key} must be {allowed}, got {got}")
