"""What the pipeline asks of turbulence: the contract of `turbulence._target_`.

A model draws the parameters of a clip and makes the operator of that clip.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Generator, Tensor

from src.sim.optics import Position

Crop = tuple[int, int, int, int]  # top, left, height, width
Frames = Float[Tensor, "n frames h w"]  # linear light
Views = Float[Tensor, "n views frames hc wc"]
Tilt = Float[Tensor, "views frames xy=2 hc wc"]  # pixels


@runtime_checkable
class ClipTurbulence(Protocol):
    """The turbulence of one clip, between its clean frames and the views of a light field.

    All randomness comes from the generator: the same state gives the same result, on any device.  A
    view depends on its own position only, and a crop is that part of the whole, to rounding.
    """

    @property
    def metadata(self) -> Mapping[str, float | int | str]:
        """What is recorded of the clip, with `severity`: none, weak, medium, strong or extreme."""

    def degrade(self, frames: Frames, generator: Generator, *, crop: Crop | None = None) -> Views:
        """Return every view of `crop` (None: the whole frame); linear light, float32."""

    def tilt(self, frames: int, generator: Generator, *, crop: Crop | None = None) -> Tilt:
        """Return the displacement that `degrade` gives its first clip."""


def describe_clip_turbulence(
    operator: ClipTurbulence, generator: Generator
) -> dict[str, float | int | str]:
    """Return what is recorded of the clip that `operator.degrade` draws from `generator`.

    An operator whose clips differ has `clip_metadata`, a function of the generator; of others it is
    their `metadata`.
    """
    of_clip = getattr(operator, "clip_metadata", None)
    return dict(operator.metadata if of_clip is None else of_clip(generator))


@runtime_checkable
class TurbulenceModel(Protocol):
    """Where the turbulence of every clip comes from."""

    def draw(self, generator: Generator) -> Any:
        """Draw the parameters of a clip: a small object that can be pickled."""

    def operator(
        self, drawn: Any, *, views: Sequence[Position], height: int, width: int, fps: float
    ) -> ClipTurbulence:
        """Return the operator of these parameters, for frames of `height` x `width` at `fps`."""


def check_option(valid: bool, name: str, allowed: str, value: object) -> None:
    """Raise ValueError, naming `turbulence.name`, unless `valid`."""
    if not valid:
        raise ValueError(f"turbulence.{name} must be {allowed}, got {value}")
