"""Config keys of earlier versions: an error that names the new key instead of an unknown one."""

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf

# Former key: its new name, or None where nothing took its place.
TABLE = Path(__file__).with_suffix(".yaml")
RENAMED_KEYS: dict[str, str | None] = yaml.safe_load(TABLE.read_text())
REFUSED_KEY = r"Could not (?:override|delete from config\.) '([\w./]+)'"  # Hydra's message


def explain_refused_key(message: str) -> str | None:
    """Return what became of the key that Hydra refuses in `message`; None for any other error."""
    found = re.search(REFUSED_KEY, message)
    return describe_renaming(found[1].replace("/", ".")) if found else None


def check_overrides(arguments: Iterable[str]) -> None:
    """Raise ValueError for a former key among the overrides of a command line."""
    for argument in arguments:
        key = re.split("[=@]", argument.lstrip("+~"))[0].replace("/", ".")
        if explanation := describe_renaming(key):
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
