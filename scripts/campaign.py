"""Trainings of hours in turn: python -m scripts.campaign PLAN [status] [clone=FOLDER] [KEY=VALUE]

    python -m scripts.campaign conf/campaign/default.yaml clone=../campaign           # start, go on
    python -m scripts.campaign conf/campaign/default.yaml clone=../campaign status    # a line each

`clone`: work in a clone of this repository, made at the commit that stands here if it is not there
yet, so that editing the project does not disturb it.  PLAN: a file as conf/campaign/default.yaml.
KEY=VALUE: more overrides for all trainings.

Whatever is killed goes on: a training from its last checkpoint when this is running, and trainings
go on without this.  Where no checkpoint is left, as on a new machine, a training goes on from the
weights it exported, with the hours these have had; seed=1, say, makes a bank of other clips.  Each
holds a lock while it runs, so that started again this finds them.  Their command lines have the
word campaign-child.  Ctrl-C and SIGTERM stop all of it, with checkpoints.
"""

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from scripts.campaign_training import ROOT, Campaign, Stop, Training

POLL_S, PATIENCE_S = 5.0, 120.0  # between two looks; for a training to store itself


def run(plan: Campaign, trainings: list[Training]) -> int:
    """Train until all is done; return 1 if a training has failed.

    Raises ValueError when another campaign works in the same folder.
    """
    Path(plan.out).mkdir(parents=True, exist_ok=True)
    with (Path(plan.out) / "campaign.lock").open("a") as alone:
        try:
            fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            reason = f"out must be a folder that no campaign works in, got {plan.out}"
            raise ValueError(reason) from error
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        try:
            while _turn(plan, trainings):
                time.sleep(POLL_S)
        finally:
            _end(trainings)
    print("\n".join(one.line() for one in trainings))
    return int(any(one.state() == "failed" for one in trainings))


def _turn(plan: Campaign, trainings: list[Training]) -> bool:
    """Start what can start, end what is flat; return whether there is more to do."""
    for one in trainings:
        one.settle()
        if one.running() and one.flat() and not (one.folder / "stopped.txt").is_file():
            print(f"{one.name} gains nothing more and ends", flush=True)
            one.end_early()
    states = [one.state() for one in trainings]
    for one, state in zip(trainings, states, strict=True):
        if state == "waiting" and states.count("running") < plan.at_once:
            one.start()
            states[trainings.index(one)] = "running"
            print(f"{time.strftime('%F %T')} {one.name} trains", flush=True)
    return "running" in states or "waiting" in states


def _end(trainings: list[Training]) -> None:
    """Let trainings store themselves and end."""
    for one in trainings:
        if one.folder.is_dir():
            one.terminate()
    end = time.monotonic() + PATIENCE_S
    while any(one.running() for one in trainings) and time.monotonic() < end:
        time.sleep(0.1)


def load(path: Path, overrides: Sequence[str] = ()) -> tuple[Campaign, list[Training]]:
    """Return what a YAML file says, and `overrides`; raises ValueError naming what is wrong."""
    try:
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
        rows = content.pop("trainings")
        stop = Stop(**content.pop("stop")) if content.get("stop") else content.pop("stop", None)
        plan = Campaign(**content, stop=stop)
        plan = plan._replace(common=[*plan.common, *overrides])
        trainings = [Training(plan, **row) for row in rows]
    except (OSError, KeyError, TypeError, AttributeError, OmegaConfBaseException) as error:
        raise ValueError(f"{path} must be as conf/campaign/default.yaml is: {error}") from error
    for name, least, most in (("at_once", 1, 64), ("threads", 1, 256), ("nice", 0, 19)):
        value = getattr(plan, name)
        if type(value) is not int or not least <= value <= most:
            raise ValueError(f"{name} must be a whole number in {least}..{most}, got {value}")
    names = [one.name for one in trainings]
    if len(set(names)) < len(names) or not names:
        raise ValueError(f"trainings must have names of their own, got {', '.join(names)}")
    return plan, trainings


def clone(folder: Path) -> None:
    """Go on in the clone `folder`, made if it is not there; never returns."""
    if not folder.is_dir():
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
        for name in (".venv", ".cache"):
            if (ROOT / name).exists():
                (folder / name).symlink_to((ROOT / name).resolve())
    given = [word for word in sys.argv[1:] if not word.startswith("clone=")]
    os.chdir(folder)
    os.execv(sys.executable, [sys.executable, "-m", "scripts.campaign", *given])


def main() -> None:
    """Read the command line."""
    words = sys.argv[1:]
    folders = [word.removeprefix("clone=") for word in words if word.startswith("clone=")]
    rest = [word for word in words if "=" not in word and word != "status"]
    overrides = [word for word in words if "=" in word and not word.startswith("clone=")]
    if len(rest) != 1 or len(folders) > 1:
        sys.exit(__doc__)
    try:
        if folders:
            clone(Path(folders[0]).resolve())
        plan, trainings = load(Path(rest[0]), overrides)
        if "status" in words:
            print("\n".join(one.line() for one in trainings))
            return
        sys.exit(run(plan, trainings))
    except ValueError as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)


if __name__ == "__main__":
    main()
