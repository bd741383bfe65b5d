"""What `--help` prints: what a command does, the choices of its groups, its keys with comments."""

import ast
import re
import sys
from contextlib import suppress
from pathlib import Path

from src import COMMAND
from src.app import console
from src.app.config_files import CONF, config_choices

CHOICE = re.compile(r"- (?:override )?/?(\w+)(?:@(\w+))?: *([\w/]+)(?: +# *(.*))?")
FOOT = """\
Any key can be given as key=value, those of a group too: --cfg job --resolve prints them all.
-m runs a sweep over values with commas; --hydra-help lists the options of Hydra."""


def show_help(config: str, file: Path) -> bool:
    """Print the help of the command in `file`, of conf/<config>.yaml, where the command line has
    --help or -h; return whether it has.
    """
    words = sys.argv[1:]
    if not {"--help", "-h"} & set(words) or "--config-name" in words:
        return False
    console.prepare_streams()
    usage = ast.get_docstring(ast.parse(file.read_text("utf-8"))) or ""
    with suppress(BrokenPipeError):  # as `| head` leaves it
        print(help_text(config, usage), flush=True)
    return True


def help_text(config: str, usage: str) -> str:
    """Return the help of the command of conf/<config>.yaml; `usage`: what it does."""
    text = (Path(CONF) / f"{config}.yaml").read_text("utf-8")
    _, _, body = text.partition("defaults:\n")
    entries = re.match(r"(?: +.*\n)*", body)
    assert entries is not None
    found = [one for entry in entries[0].splitlines() if (one := CHOICE.fullmatch(entry.strip()))]
    groups = [line for one in found if (line := _describe_group(one))]
    parts = [body[entries.end() :].strip(), *map(_read_keys_of_its_own, found)]
    keys = "\n\n".join(filter(None, parts)).replace("???     ", "required")
    chosen = ["Groups (group=choice):", *groups, ""] if groups else []
    use = usage.strip().replace("python -m src.", COMMAND)
    return "\n".join([use, "", *chosen, "Keys (key=value):", keys, "", FOOT])


def _read_keys_of_its_own(entry: re.Match) -> str:
    """Return the keys, of the command and not of the group, of a group of one file; "" of others.

    They stand at the end, as `time_unit` and others of `reading` do.
    """
    group, _, chosen, _ = entry.groups()
    if config_choices(group) != [chosen]:
        return ""
    package, _, keys = (Path(CONF) / group / f"{chosen}.yaml").read_text("utf-8").partition("\n")
    return keys.strip() if package == "# @package _global_" else ""


def _describe_group(entry: re.Match) -> str:
    """Return the line of an entry of the defaults, "" where it is no choice of the user's."""
    group, key, chosen, comment = entry.groups()
    names = [name for name in config_choices(group) if name != chosen]
    if not names or group in ("paths", "hydra"):
        return ""
    line = f"  {key or group}={chosen}".ljust(28) + f" or {', '.join(names)}"
    return line + f"  # {comment}" * bool(comment)
