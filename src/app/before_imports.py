"""What a command line gets before the seconds of imports: its help, or what is wrong with it."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from src.app import console
from src.app.help import show_help

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
    conf/<config>.yaml does not take.

    Words with options of Hydra, such as -m or hydra.searchpath, are left to Hydra: there may be
    other configs, or several jobs.
    """
    from src.app.compose import compose_checked_config  # the help does without Hydra

    if any(map(OPTION_OF_HYDRA.match, words)):
        return
    try:
        compose_checked_config(config, [], words)
    except ValueError as error:
        console.exit_with_error(str(error))
