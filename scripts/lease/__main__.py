"""Trainings in the minutes that a GPU can be had: python -m scripts.lease PLAN --minutes N

    python -m scripts.lease folder FOLDER conf/lease/default.yaml scenes=photos.pack  # gather
    python -m scripts.lease check FOLDER/plan.yaml --minutes 12     # does it fit?  Nothing is run
    python -m scripts.lease FOLDER/plan.yaml --minutes 12 [only=lf3x3,single256] [out=out/lease]
    python -m scripts.lease join out/lease [to=weights/mine]        # one file a network

One process checks the device, fills a pre-simulated turbulence cache in its memory and trains the
networks of PLAN, a file as conf/lease/default.yaml, in turn, each by wall time with the rate
brought to its end; it may be killed at any time, and what is in `out` is usable.  `join` makes of
that what `ckpt=` of src.train and `start` of a plan continue from.  `folder` gathers what a lease
needs, 60 MiB at most.  Minutes count from the start of the process; exit code 0: all networks that
are not optional were trained to their end, 1: one was not, or nothing was, 2: the plan does not fit
or is none.
"""

import argparse
import math
import sys
import time
from pathlib import Path

from src.app.script import run_script

START = time.monotonic()  # before the imports below, which take seconds
DEFAULT_OUT = "out/lease"
OPTIONS = {"join": (2, {"to"}), "folder": (3, {"scenes", "lpips"}), "check": (2, {"only"})}


def main() -> None:
    """Do what the command line says and exit with its code."""
    sys.exit(run_command(*parse(sys.argv[1:])))


def run_command(words: list[str], options: dict[str, str], minutes: float) -> int:
    """Do what the command line says; return the exit code."""
    from scripts.lease import export, folder
    from scripts.lease.plan import load_plan
    from scripts.lease.run import run_lease
    from scripts.lease.selection import select_networks, size_network

    if words[0] == "join":
        made, lost = export.join_exports(Path(words[1]), Path(options.get("to", words[1])))
        lines = [*map(folder.describe_export, made), *(f"lost: {line}" for line in lost)]
        print("\n".join(lines))
        return int(bool(lost))
    if words[0] == "folder":
        given = {key: Path(path) for key, path in options.items()}
        print(folder.gather_files(Path(words[1]), Path(words[2]), given))
        return 0
    plan = load_plan(Path(words[-1]))
    if "only" in options:
        plan = plan.select(options["only"].split(","))
    networks = [size_network(plan, network) for network in plan.networks]
    selection = select_networks(plan, networks, minutes)
    if words[0] == "check":
        print(folder.describe_selection(plan, selection, minutes))
        return 0
    return run_lease(plan, selection, minutes, START, Path(options.get("out", DEFAULT_OUT)))


def parse(given: list[str]) -> tuple[list[str], dict[str, str], float]:
    """Return the words, the options key=value and the minutes; exits where they make no command."""
    parser = argparse.ArgumentParser(
        "python -m scripts.lease",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("words", nargs="*", help="one of the commands above")
    parser.add_argument("--minutes", type=float, default=0.0)
    asked = parser.parse_intermixed_args(given)
    words = [word for word in asked.words if "=" not in word]
    options = dict(word.split("=", 1) for word in asked.words if "=" in word)
    count, keys = OPTIONS.get(words[0] if words else "", (1, {"only", "out"}))
    is_timed = not words or words[0] not in ("join", "folder")
    has_minutes = 0 < asked.minutes < math.inf
    if len(words) != count or set(options) - keys or is_timed != has_minutes:
        parser.error("no such command; --help lists them")
    return words, options, asked.minutes


if __name__ == "__main__":
    run_script(main)
