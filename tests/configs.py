"""Configs are composed at every turn of the tests: Hydra reads a file once, until it is changed,
and puts the same files of conf/ together once for the same overrides.
"""

import os
import pickle
import re
from pathlib import Path

import pytest
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobRuntime
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig

CONF = Path(__file__).resolve().parents[1] / "conf"

_read: dict[tuple, bytes] = {}
_composed: dict[tuple, bytes] = {}
_compose = ConfigLoaderImpl._load_configuration_impl


class RememberingRepository(ConfigRepository):
    """Hands out copies of what it has read, also for earlier configs."""

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Return what the file of that path, without its ending, holds."""
        source = self._find_object_source(config_path, ObjectType.CONFIG)
        if source is None or source.scheme() not in ("file", "pkg"):
            return super().load_config(config_path)
        key = source.scheme(), source.path, source.provider, config_path
        if source.scheme() == "file":
            stat = os.stat(os.path.join(source.path, source._normalize_file_name(config_path)))
            key += stat.st_ino, stat.st_mtime_ns, stat.st_size
        if key not in _read:
            _read[key] = pickle.dumps(super().load_config(config_path))
        return pickle.loads(_read[key])


def compose_once(
    self, config_name, overrides, run_mode, from_shell=True, validate_sweep_overrides=True
) -> DictConfig:
    """Return a config of conf/ that was composed before in the same folder, or compose it."""
    given = config_name, overrides, run_mode
    places = [place.path for place in self.config_search_path.get_path()]
    files = [place for place in places if "://" not in place or place.startswith("file://")]
    own = all(Path(place.removeprefix("file://")) == CONF for place in files)
    if not own or any(re.search(r"hydra\.(searchpath|job)", override) for override in overrides):
        return _compose(self, *given, from_shell, validate_sweep_overrides)
    key = *places, os.getcwd(), config_name, *overrides, run_mode
    if key not in _composed:
        cfg = _compose(self, *given, from_shell, validate_sweep_overrides)
        _composed[key] = pickle.dumps(cfg)
    elif validate_sweep_overrides:
        parsed = OverridesParser.create().parse_overrides(overrides)
        self.validate_sweep_overrides_legal(parsed, run_mode, from_shell)
    cfg = pickle.loads(_composed[key])
    cfg.hydra.job.name = JobRuntime.instance().get("name")
    return cfg


def remember_configs(patched: pytest.MonkeyPatch) -> None:
    """Make Hydra remember, while `patched` is."""
    patched.setattr(config_loader_impl, "ConfigRepository", RememberingRepository)
    patched.setattr(ConfigLoaderImpl, "_load_configuration_impl", compose_once)
