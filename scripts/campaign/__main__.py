"""Shipped networks from nothing: python -m scripts.campaign RECIPE ... [status] [KEY=VALUE ...]

    python -m scripts.campaign lf3x3 single256 clone=../campaign           # start, or go on
    python -m scripts.campaign lf3x3 single256 clone=../campaign status    # a line each

RECIPE: a file of conf/recipe without .yaml (lf3x3, clean/etnet), or the path of such a file; `all`:
all of them.  Each runs its stages in order and ends with weights, card and learning curve in
`OUT/weights`.  Of the campaign: `clone`, a folder to work in, cloned from this repository at its
commit if it is not there, so that editing does not disturb it; `out` (out/campaign), `parallel`
(trainings side by side, 2), `threads` of each (1), `nice` (19), `max_failures` (3, in a row and
without a new checkpoint).  Any other KEY=VALUE is an override of all trainings, such as
scene.root=PHOTOGRAPHS.

Whatever is killed goes on: a training from its last checkpoint when this is started again, and
trainings go on without this.  Each holds a lock while it runs, so that this finds them.  Their
command lines have the word campaign-child.  Ctrl-C and SIGTERM stop all, with checkpoints.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

from scripts.campaign import driver
from scripts.campaign.recipe import ROOT, names, read
from scripts.campaign.training import Settings
from scripts.campaign.work import RecipeWork
from src.app.script import run_script
from src.records.results import git_commit

OWN = ("out", "clone", *Settings._fields[1:])
LIMITS = {"parallel": (1, 64), "threads": (1, 256), "nice": (0, 19), "max_failures": (1, 100)}


def settings(given: dict[str, str]) -> Settings:
    """Return the settings of the campaign; raises ValueError for a number out of its range."""
    values: dict = {"out": Path(given["out"])} if "out" in given else {}
    for name, (low, high) in LIMITS.items():
        text = given.get(name)
        if text is not None:
            if not (text.isdecimal() and low <= int(text) <= high):
                raise ValueError(f"{name} must be a whole number in {low}..{high}, got {text}")
            values[name] = int(text)
    return Settings(**values)


def work_in_clone(folder: Path) -> None:
    """Go on in the clone `folder`, made if it is not there; never returns."""
    if not folder.is_dir():
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
        for name in (".venv", ".cache"):
            if (ROOT / name).exists():
                (folder / name).symlink_to((ROOT / name).resolve())
    given = [word for word in sys.argv[1:] if not word.startswith("clone=")]
    os.chdir(folder)
    os.execv(sys.executable, [sys.executable, "-m", "scripts.campaign", *given])


def run(words: list[str]) -> int:
    """Do what the command line says; return the exit code."""
    pairs = dict(word.split("=", 1) for word in words if word.split("=")[0] in OWN and "=" in word)
    chosen = [word for word in words if "=" not in word and word != "status"]
    overrides = [word for word in words if "=" in word and word.split("=")[0] not in OWN]
    if not chosen:
        raise ValueError(f"recipe must be one or more of {', '.join(names())}, or all, got none")
    if "clone" in pairs:
        work_in_clone(Path(pairs["clone"]).resolve())
    given = settings(pairs)
    recipes = [read(name, overrides) for name in (names() if chosen == ["all"] else chosen)]
    works = [RecipeWork(recipe, given) for recipe in recipes]
    if "status" in words:
        print("\n".join(work.line() for work in works))
        return 0
    if (commit := git_commit()).endswith("-dirty"):  # such weights are not shipped
        raise ValueError(f"a campaign runs at a commit, got {commit}: commit, or clone=FOLDER")
    return driver.run(given, works)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        "python -m scripts.campaign",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("words", nargs="*", help="recipes, status and KEY=VALUE, as above")
    words = parser.parse_args().words
    sys.exit(run(words))


if __name__ == "__main__":
    run_script(main)
