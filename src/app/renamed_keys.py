"""Config keys and choices of earlier versions: an error that names the new one."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf

# Former key, or group=choice: its new name, or None where nothing took its place.
TABLES = [Path(__file__).with_name(name) for name in ("renamed_keys.yaml", "renamed_choices.yaml")]
RENAMED_KEYS: dict[str, str | None] = {
    old: new for table in TABLES for old, new in yaml.safe_load(table.read_text()).items()
}
REFUSED_KEY = r"Could not (?:override|delete from config\.) '([\w./]+)'"  # Hydra's messages
LISTED = "--cfg job lists the keys"
MISSING_VALUE = r"Missing mandatory value: ([\w.]+)"
REFUSED_CHOICE = r"Could not find '([\w/]+)/(\w+)'"


def explain_refused_key(message: str) -> str | None:
    """Return what became of the key or choice that Hydra refuses in `message`, that there is no
    such key, or that it must be given; None for any other error.
    """
    if found := re.search(MISSING_VALUE, message):
        return f"{found[1]} must be given: {found[1]}=..."
    if found := re.search(REFUSED_CHOICE, message):
        return describe_renaming(f"{found[1]}={found[2]}")
    if found := re.search(REFUSED_KEY, message):
        key = found[1].replace("/", ".")
        return describe_renaming(key) or f"{key} is no key of the configuration; {LISTED}"
    return None


def check_overrides(arguments: Iterable[str]) -> None:
    """Raise ValueError for a former key or choice among the overrides of a command line."""
    for argument in arguments:
        name, _, value = argument.lstrip("+~").partition("=")
        key = name.split("@")[0].replace("/", ".")
        for former in (key, *(f"{key}={choice.strip()}" for choice in value.split(","))):
            if explanation := describe_renaming(former):
                raise ValueError(explanation)


def check_keys(cfg: DictConfig) -> None:
    """Raise ValueError for a former key in `cfg`, such as one of a user's config file."""
    for key in _flatten_keys(OmegaConf.to_container(cfg, resolve=False)):
        if explanation := describe_renaming(key):
            raise ValueError(explanation)


def describe_renaming(key: str) -> str | None:
    """Return "<key> is now <new key>" for a former key or a key below one, else None."""
    for end in range(len(key), 0, -1):  # the longest former key that `key` begins with
        if key[:end] in RENAMED_KEYS and key[end : end + 1] in ("", "."):
            renamed = RENAMED_KEYS[key[:end]]
            return f"{key} is now {renamed}{key[end:]}" if renamed else f"{key} was removed"
    return None


def _flatten_keys(node: object, prefix: str = "") -> Iterator[str]:
    """Yield the dotted key of every node in nested dicts but those of a class of the user's own."""
    if isinstance(node, Mapping):
        if not str(node.get("_target_", "src.")).startswith(("src.", "baselines.")):
            return
        for name, child in node.items():
            yield f"{prefix}{name}"
            yield from _flatten_keys(child, f"{prefix}{name}.")
