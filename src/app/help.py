"""What `--help` prints: what a command does, the choices of its groups, its keys with comments."""

import re
from pathlib import Path

from src.app.compose import CONF, config_choices

CHOICE = re.compile(r"- (?:override )?/?(\w+)(?:@(\w+))?: *([\w/]+)(?: +# *(.*))?")
FOOT = """\
Any key can be given as key=value, those of a group too: --cfg job --resolve prints them all.
-m runs a sweep over values with commas; --hydra-help lists the options of Hydra."""


def help_text(config: str, usage: str) -> str:
    """Return the help of the command of conf/<config>.yaml; `usage`: what it does."""
    text = (Path(CONF) / f"{config}.yaml").read_text("utf-8")
    _, _, body = text.partition("defaults:\n")
    entries = re.match(r"(?: +.*\n)*", body)
    assert entries is not None
    groups = [line for entry in entries[0].splitlines() if (line := _describe_group(entry.strip()))]
    keys = body[entries.end() :].strip().replace("???     ", "required")
    chosen = ["Groups (group=choice):", *groups, ""] if groups else []
    return "\n".join([usage.strip(), "", *chosen, "Keys (key=value):", keys, "", FOOT])


def _describe_group(entry: str) -> str:
    """Return the line of an entry of the defaults, "" where it is no choice of the user's."""
    found = CHOICE.fullmatch(entry)
    if found is None or found[1] in ("paths", "hydra"):
        return ""
    group, key, chosen, comment = found.groups()
    names = [name for name in config_choices(group) if name != chosen]
    line = f"  {key or group}={chosen}".ljust(28) + f" or {', '.join(names)}" * bool(names)
    return line + f"  # {comment}" * bool(comment)
