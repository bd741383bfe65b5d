"""Going on from exported weights where no checkpoint is left; the optimiser starts anew."""

from collections.abc import Iterable
from pathlib import Path

from src.models import files
from src.training.curve import Curve
from src.training.reconstructor import Reconstructor


def take(module: Reconstructor, callbacks: Iterable, path: Path) -> None:
    """Give `module` the weights, time, steps and windows, and the curve among `callbacks` the
    lines so far, of `path`, a file that a Curve exported.

    Raises ValueError for weights that were written otherwise.
    """
    card = files.card(path)
    if "curve" not in card:
        raise ValueError(f"ckpt must be a checkpoint or what `export` wrote to go on, got {path}")
    files.restore(module.network, path)
    if module.average is not None:
        module.average.load_state_dict(module.network.state_dict())
    module.clock.seconds, module.windows_seen = 3600 * card["hours"], card["windows"]
    module.steps_before = card["steps"]
    for curve in (found for found in callbacks if isinstance(found, Curve)):
        curve.rows, curve.loss = card["curve"], card["loss"]
        curve.steps = card["steps"] - curve.rows[-1]["steps"]
