"""Going on from exported weights where no checkpoint is left; the optimiser starts anew."""

from collections.abc import Iterable
from pathlib import Path

from src.models import files
from src.training.curve import Curve
from src.training.reconstructor import Reconstructor

REACHED = "reached"  # what a training goes on from, in the card of shipped weights


def reached(path: Path) -> dict:
    """Return hours, windows, steps, the loss since the last line of the curve, and the curve so far
    of the weights `path`: what a Curve exported, or shipped weights of a training with one.

    Raises ValueError for weights that were written otherwise.
    """
    card = files.card(path)
    card = card.get(REACHED, card)
    if "curve" not in card:
        raise ValueError(f"ckpt must be a checkpoint or weights with a learning curve, got {path}")
    return card


def take(module: Reconstructor, callbacks: Iterable, path: Path) -> None:
    """Give `module` the weights, time, steps and windows, and the curve among `callbacks` the
    lines so far, of `path`; ValueError as `reached` raises it.
    """
    before = reached(path)
    files.restore(module.network, path)
    if module.average is not None:
        module.average.load_state_dict(module.network.state_dict())
    module.clock.seconds, module.windows_seen = 3600 * before["hours"], before["windows"]
    module.steps_before = before["steps"]
    for curve in (found for found in callbacks if isinstance(found, Curve)):
        rows = before["curve"]
        curve.go_on(rows, before["loss"], before["steps"] - rows[-1]["steps"])
