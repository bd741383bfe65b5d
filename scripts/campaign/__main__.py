"""Shipped networks from nothing: python -m scripts.campaign RECIPE ... [status] [KEY=VALUE ...]

    python -m scripts.campaign lf3x3 single256 clone=../campaign           # start, or go on
    python -m scripts.campaign lf3x3 single256 clone=../campaign status    # a line each

RECIPE: a file of conf/recipe without .yaml (lf3x3, clean/etnet), or the path of such a file; `all`:
all of them.  Each runs its stages in order and ends with weights, card and learning curve in
`OUT/weights`.  Of the campaign: `clone`, a folder to work in, cloned from this repository at its
commit if it is not there, so that editing does not disturb it; `out` (out/campaign, in the clone),
`parallel` (trainings side by side, 2), `threads` of each (1), `nice` (19), `max_failures` (3, in a
row and without a new checkpoint).  Any other KEY=VALUE is an override of all trainings, above those
of recipes and stages, such as scene.root=PHOTOGRAPHS.  Paths are those of the folder this is
started in.

Whatever is killed goes on: a training from its last checkpoint when this is started again, and
trainings go on without this.  Each holds a lock while it runs, so that this finds them.  Their
command lines have the word campaign-child.  Ctrl-C and SIGTERM stop all, with checkpoints.  A wrong
value ends a training at once; `status` says why one has failed and where its log is; it is tried
again when this is started again.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from scripts.campaign import driver
from scripts.campaign.recipe import ROOT, Recipe, names, reached_hours, read
from scripts.campaign.training import Settings
from scripts.campaign.work import RecipeWork
from src.app.path_overrides import is_path_key
from src.app.script import run_script
from src.models import files
from src.records.results import git_commit

LIMITS = {"parallel": (1, 64), "threads": (1, 256), "nice": (0, 19), "max_failures": (1, 100)}
OWN = ("out", "clone", *LIMITS)


def settings(given: dict[str, str], overrides: Sequence[str] = ()) -> Settings:
    """Return the settings of the campaign; raises ValueError for a number out of its range."""
    values: dict = {"out": Path(given["out"])} if "out" in given else {}
    values["overrides"] = overrides
    for name, (low, high) in LIMITS.items():
        text = given.get(name)
        if text is not None:
            if not (text.isdecimal() and low <= int(text) <= high):
                raise ValueError(f"{name} must be a whole number in {low}..{high}, got {text}")
            values[name] = int(text)
    return Settings(**values)


def work_in_clone(folder: Path, words: Sequence[str]) -> None:
    """Go on with `words` in the clone `folder`, made if it is not there; never returns.

    Raises ValueError for a folder that is no clone and for one that cannot be made.
    """
    if not folder.exists():
        command = ["git", "clone", "--quiet", str(ROOT), str(folder)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"clone must be a folder to make, got {folder}: {done.stderr}")
        for name in (".venv", ".cache"):
            if (ROOT / name).exists():
                (folder / name).symlink_to((ROOT / name).resolve())
    if not (folder / "scripts" / "campaign").is_dir():
        raise ValueError(f"clone must be a new folder or a clone of this repository, got {folder}")
    given = [word for word in words if not word.startswith("clone=")]
    os.chdir(folder)
    os.execv(sys.executable, [sys.executable, "-m", "scripts.campaign", *given])


def with_whole_paths(word: str) -> str:
    """Return a word of the command line with recipes, `out`, `clone` and paths that are there
    absolute."""
    key, equals, value = word.partition("=")
    if not equals:
        return str(Path(word).resolve()) if word.endswith(".yaml") else word
    if key in ("out", "clone"):
        return f"{key}={Path(value).resolve()}"
    if not is_path_key(key.lstrip("+"), "train"):
        return word
    is_list = value[:1] == "[" and value[-1:] == "]"
    paths = [_whole_path(one.strip()) for one in value[1:-1].split(",")] if is_list else []
    return f"{key}=[{','.join(paths)}]" if is_list else f"{key}={_whole_path(value)}"


def _whole_path(name: str) -> str:
    """Return a path that is there as an absolute one; what else `name` may be as it is."""
    path = Path(name)
    is_there = name != "" and files.locate(name) == path and path.exists()
    return str(path.resolve()) if is_there else name


def check_hours(recipes: Sequence[Recipe]) -> None:
    """Raise ValueError for a stage that has no hours left after the network it goes on from, one of
    `recipes` or a shipped one."""
    reached = {recipe.name: reached_hours(recipe) for recipe in recipes}
    for name in {name for recipe in recipes for name in recipe.after} - set(reached):
        if (shipped := files.WEIGHTS / f"{name}.safetensors").is_file():
            reached[name] = files.read_card(shipped).get("hours", 0.0)
    for recipe in recipes:
        reached_hours(recipe, reached)


def run(words: list[str]) -> int:
    """Do what the command line says; return the exit code."""
    words = [with_whole_paths(word) for word in words]
    pairs = dict(word.split("=", 1) for word in words if word.split("=")[0] in OWN and "=" in word)
    chosen = [word for word in words if "=" not in word and word != "status"]
    overrides = [word for word in words if "=" in word and word.split("=")[0] not in OWN]
    if not chosen:
        raise ValueError(f"recipe must be one or more of {', '.join(names())}, or all, got none")
    if "clone" in pairs:
        work_in_clone(Path(pairs["clone"]), words)
    given = settings(pairs, overrides)
    recipes = [read(name) for name in (names() if chosen == ["all"] else chosen)]
    check_hours(recipes)
    works = [RecipeWork(recipe, given) for recipe in recipes]
    if "status" in words:
        print("\n".join(work.line() for work in works))
        return 0
    if (commit := git_commit()).endswith("-dirty"):  # such weights are not shipped
        raise ValueError(f"a campaign runs at a commit, got {commit}: commit, or clone=FOLDER")
    for work in works:
        work.check_stages()
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
