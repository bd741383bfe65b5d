"""Config keys and choices that are none: an error that names the new or the nearest one."""

import re
from collections.abc import Collection, Iterator, Mapping
from difflib import get_close_matches
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
CHOICES = r"Could not find '([\w/]+)'\s+Available options in '([\w/]+)':(.*?)Config search path"
NEAR = 0.65  # of SequenceMatcher.ratio: two swapped letters of three


def explain_refused_key(message: str, keys: Collection[str] = ()) -> str | None:
    """Return what became of the key or choice that Hydra refuses in `message`, that there is no
    such one, with the nearest of `keys` or choices, or that it must be given; None for any other
    error.
    """
    if found := re.search(MISSING_VALUE, message):
        return f"{found[1]} must be given: {found[1]}=..."
    if found := re.search(REFUSED_CHOICE, message):
        return describe_renaming(f"{found[1]}={found[2]}") or _describe_choices(message)
    if found := re.search(REFUSED_KEY, message):
        key = found[1].replace("/", ".")
        is_added = "Could not override" in message and f"{key.rpartition('.')[0]}._target_" in keys
        return describe_renaming(key) or describe_unknown_key(key, keys, is_added)
    return None


def describe_unknown_key(key: str, keys: Collection[str], is_added: bool = False) -> str:
    """Return that `key` is none, and its nearest neighbour in `keys` or how to list them.

    `keys`: all groups, and those of the default choices; one of these is none with what was chosen
    instead.  `is_added`: whether `+` would add it, as an argument of the class that its node names.
    """
    if key in keys and "." in key:
        return f"{key} is no key of the chosen {key.partition('.')[0]}; {LISTED}"
    parent = key.rpartition(".")[0]
    near = [k for k in keys if k.rpartition(".")[0] == parent and k != key]  # key: another's group
    hint = _ask_for_nearest(key, near, len(parent))
    if is_added:
        hint += f"; +{key}=... adds it to the arguments of {parent}"
    return f"{key} is no key of the configuration{hint or f'; {LISTED}'}"


def _describe_choices(message: str) -> str | None:
    found = re.search(CHOICES, message, re.S)
    if found is None:
        return None
    choices, got = found[3].split(), found[1].removeprefix(f"{found[2]}/")
    listed = f"{found[2]} must be one of {', '.join(choices)}, got {got}"
    return listed + _ask_for_nearest(got, choices)


def _ask_for_nearest(name: str, names: Collection[str], start: int = 0) -> str:
    """Compare the names from their letter `start` on."""
    near = get_close_matches(name[start:], [other[start:] for other in names], 1, NEAR)
    return f"; did you mean {name[:start]}{near[0]}?" if near else ""


def refuse_renamed_keys(cfg: DictConfig) -> None:
    """Raise ValueError for a former key in `cfg`, such as one of a user's config file, or one added
    by `+`; arguments of classes of other packages have any names.
    """
    for key in flatten_keys(_drop_other_classes(OmegaConf.to_container(cfg, resolve=False))):
        if explanation := describe_renaming(key):
            raise ValueError(explanation)


def describe_renaming(key: str) -> str | None:
    """Return "<key> is now <new key>" for a former key or a key below one, else None."""
    for end in range(len(key), 0, -1):  # the longest former key that `key` begins with
        if key[:end] in RENAMED_KEYS and key[end : end + 1] in ("", "."):
            renamed = RENAMED_KEYS[key[:end]]
            return f"{key} is now {renamed}{key[end:]}" if renamed else f"{key} was removed"
    return None


def flatten_keys(node: object, prefix: str = "") -> Iterator[str]:
    """Yield the dotted key of every node in nested dicts."""
    if isinstance(node, Mapping):
        for name, child in node.items():
            yield f"{prefix}{name}"
            yield from flatten_keys(child, f"{prefix}{name}.")


def _drop_other_classes(node: object) -> object:
    """Return nested dicts without the arguments of classes that are not of this project."""
    if not isinstance(node, Mapping):
        return node
    if not str(node.get("_target_", "src.")).startswith(("src.", "baselines.")):
        return None
    return {name: _drop_other_classes(child) for name, child in node.items()}
