"""Air of which all is drawn and all but the pixels computed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.turbulence import whole_clip
from src.sim.turbulence.model import Crop


@dataclass(frozen=True)
class AirAhead:
    """The air of one clip in `crop`, ready for a device (model.py): what Turbulence.ahead returns.

    All is drawn, so no generator is asked.  Raises ValueError for another crop or number of clips.
    """

    facts: Mapping[str, float | int | str]
    crop: Crop
    plans: Sequence[whole_clip.Plan]

    @torch.no_grad()
    def degrade(
        self,
        frames: Float[Tensor, "one frames h w"],
        generator: torch.Generator,
        *,
        crop: Crop | None = None,
    ) -> Float[Tensor, "one views frames hc wc"]:
        """Return what every view sees of `crop`."""
        self._check(len(frames), crop)
        return whole_clip.degrade(frames[0].float(), self.plans)[None]

    @torch.no_grad()
    def tilt(
        self, frames: int, generator: torch.Generator, *, crop: Crop | None = None
    ) -> Float[Tensor, "views frames 2 hc wc"]:
        """Return the displacement (x, y) in pixels."""
        self._check(1, crop)
        return whole_clip.tilt(self.plans, frames)

    def _check(self, clips: int, crop: Crop | None) -> None:
        if (clips, crop) != (1, self.crop):
            raise ValueError(f"air ahead is of 1 clip in {self.crop}, got {clips} in {crop}")
