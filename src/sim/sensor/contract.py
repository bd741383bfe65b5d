"""What the pipeline asks of a sensor: the contract of `sensor._target_`.

The class is given the values of the config and `seed`; `input`, where the config has it, is
`linear` for frames that were decoded before the turbulence.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Sensor(Protocol):
    """The pixels behind all views.

    `write=` of src.simulate and src.stress also want `events` of it, `calibrate task=threshold`
    `counts`, as in `EventSensor`.
    """

    threshold: Any  # of the sensor that `draw` returns, a number: recorded, and given to `voxels`
    drawn: Mapping[str, Any]  # names of the attributes that differ from clip to clip: recorded

    def draw(self, key: int, seed: int | None = None) -> "Sensor":
        """Return the sensor of one clip, all that is random about it drawn from `key`, its pixels
        those of `seed` (None: of its own)."""
        ...

    def voxels(
        self,
        frames: Float[Tensor, "n views frames h w"],
        fps: float,
        bins: int = 5,
        *,
        substeps: int = 1,
        clips: Sequence[int] | None = None,
        views: Sequence[int] | None = None,
        origin: tuple[int, int] = (0, 0),
        full_width: int | None = None,
        threshold: Float[torch.Tensor, " n"] | None = None,
    ) -> Float[Tensor, "n views windows bins h w"]:
        """Return one grid per window of `substeps` frame intervals; see `EventSensor.voxels`."""
        ...
