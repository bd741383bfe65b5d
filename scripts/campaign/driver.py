"""The loop of a campaign: recipes side by side, each stage by stage."""

import fcntl
import time
from pathlib import Path

from scripts.campaign.training import Settings, Training
from scripts.campaign.work import RecipeWork
from src.app.stop_signals import stop_by_signals

POLL_S, PATIENCE_S = 5.0, 120.0  # between two looks; for a training to store itself


def run(settings: Settings, recipes: list[RecipeWork]) -> int:
    """Train until all is done, also what failed before; return 1 if a training has failed.

    Raises ValueError when another campaign works in the same folder.
    """
    Path(settings.out).mkdir(parents=True, exist_ok=True)
    with (Path(settings.out) / "campaign.lock").open("a") as alone:
        try:
            fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            reason = f"out must be a folder that no campaign works in, got {settings.out}"
            raise ValueError(reason) from error
        for work in recipes:
            work.try_again()
        with stop_by_signals():
            try:
                while _turn(settings, recipes):
                    time.sleep(POLL_S)
            finally:
                _end([training for work in recipes for training in work.trainings.values()])
    print("\n".join(work.line() for work in recipes))
    return int(any(work.state() == "failed" for work in recipes))


def _turn(settings: Settings, recipes: list[RecipeWork]) -> bool:
    """Start what can start; return whether there is more to do."""
    for work in recipes:
        for training in work.trainings.values():
            training.settle()
    states = [work.state() for work in recipes]

    def is_ready(work: RecipeWork) -> bool:
        named = zip(recipes, states, strict=True)
        return work.ready({other.name for other, state in named if state != "done"})

    for place, work in enumerate(recipes):
        turn = states[place] == "waiting" and states.count("running") < settings.parallel
        if turn and is_ready(work):
            states[place] = "done"
            if work.advance():
                work.start()
                states[place] = "running"
                print(f"{time.strftime('%F %T')} {work.line()}", flush=True)
    waiting = [work for work, state in zip(recipes, states, strict=True) if state == "waiting"]
    stuck = [work for work in waiting if not is_ready(work)]
    if stuck and "running" not in states and len(waiting) == len(stuck):
        needs = ", ".join(sorted({name for work in stuck for name in work.recipe.after}))
        raise ValueError(f"{stuck[0].name} needs the networks {needs}: train them too")
    return "running" in states or "waiting" in states


def _end(trainings: list[Training]) -> None:
    """Let trainings store themselves and end."""
    for training in trainings:
        training.terminate()
    end = time.monotonic() + PATIENCE_S
    while any(training.running() for training in trainings) and time.monotonic() < end:
        time.sleep(0.1)
