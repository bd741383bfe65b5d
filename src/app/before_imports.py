"""What a command line gets before the seconds of imports: its help, or what is wrong with it."""

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from src.app import console
from src.app.help import show_help

INPUTS = ("recording", "video", "videos", "photo", "run")  # keys of files and folders that are read
OPTION_OF_HYDRA = re.compile(r"-|\+*hydra(?!\.run\.dir=)")  # that folder is none


def answer_before_imports(config: str, file: Path) -> None:
    """End the process where the command line of the command in `file`, of conf/<config>.yaml, asks
    for help, exit code 0, or has a key or a value that is none, with one line and exit code 2."""
    if show_help(config, file):
        sys.exit()
    console.prepare_streams()
    refuse_wrong_overrides(config, sys.argv[1:])


def refuse_wrong_overrides(config: str, words: Sequence[str]) -> None:
    """End the process with one line and exit code 2 for a key, a choice or a value in `words` that
    conf/<config>.yaml does not take, one that it lacks and an input that is not there.

    Words with options of Hydra, such as -m or hydra.searchpath, are left to Hydra: there may be
    other configs, or several jobs.
    """
    from src.app.compose import compose_checked_config  # the help does without Hydra

    if any(map(OPTION_OF_HYDRA.match, words)):
        return
    try:
        refuse_missing_inputs(compose_checked_config(config, [], words))
    except ValueError as error:
        console.exit_with_error(str(error))


def refuse_missing_inputs(cfg: Mapping[str, Any]) -> None:
    """Raise ValueError for a key that must be given and an input that is not there."""
    from omegaconf import OmegaConf

    missing = [key for key in cfg if OmegaConf.is_missing(cfg, key)]
    unused = "recording" if "task" not in missing and cfg["task"] == "air" else "video"
    for key in missing:
        if key != unused:  # calibrate has both
            raise ValueError(f"{key} must be given: {key}=...")
    for key in INPUTS:
        value = cfg.get(key) if key not in missing else None
        for path in map(str, [value] if isinstance(value, str) else value or []):
            if why := _why_not_there(path):
                raise ValueError(f"{key} must be a file or a folder, got {path}: {why}")


def _why_not_there(path: str) -> str:
    """Return why `path` is no file or folder; "" for one and for a live address."""
    if "://" in path:
        return ""
    try:
        Path(path).stat()
    except OSError as error:
        return str(error.strerror).lower()
    return ""
