"""What the pipeline asks of turbulence: the contract of `turbulence._target_`.

A model draws what is random about the air of a clip and makes the operator of that clip; both
classes here, simulated.py and recorded.py, keep to it, and so can a class of one's own.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.optics import Position

Crop = tuple[int, int, int, int]  # top, left, height, width


@runtime_checkable
class Air(Protocol):
    """The air of one clip, between its clean frames and the views of a light field.

    All randomness comes from the generator: the same state gives the same air, on any device.  A
    view depends on its own position only, not on which others there are, and a crop is that part of
    the whole.
    """

    @property
    def facts(self) -> Mapping[str, float | int | str]:
        """What is recorded about the clip; `severity` (weak, medium, strong or none) is there."""
        ...

    def degrade(
        self,
        frames: Float[Tensor, "n frames h w"],
        generator: torch.Generator,
        *,
        crop: Crop | None = None,
    ) -> Float[Tensor, "n views frames hc wc"]:
        """Return what every view sees of `crop` (None: of the whole); linear light, float32."""
        ...

    def tilt(
        self, frames: int, generator: torch.Generator, *, crop: Crop | None = None
    ) -> Float[Tensor, "views frames 2 hc wc"]:
        """Return the displacement (x, y) in pixels that `degrade` gives its first clip."""
        ...


@runtime_checkable
class PreparedAir(Air, Protocol):
    """Air that can be prepared by another process than that which computes its pixels."""

    def ahead(self, frames: int, generator: torch.Generator, crop: Crop) -> Any:
        """Return a thing with `degrade` alone, as above, for one clip of so many frames and that
        crop; it can be pickled.
        """
        ...


@runtime_checkable
class TurbulenceModel(Protocol):
    """Where the air of every clip comes from."""

    def draw(self, generator: torch.Generator) -> Any:
        """Draw what is random about a clip's air: a small thing that can be pickled."""
        ...

    def operator(
        self, drawn: Any, *, views: Sequence[Position], height: int, width: int, fps: float
    ) -> Air:
        """Return the air drawn, for frames of `height` x `width` pixels at `fps`."""
        ...
