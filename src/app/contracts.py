"""What the parts of a config are asked for: the contracts that a class of one's own keeps."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from src.sim.scenes.photographs import Clip
from src.sim.sensor.contract import Sensor
from src.sim.turbulence.model import TurbulenceModel


@runtime_checkable
class Scene(Protocol):
    """Where clean clips come from; the class is given `split`, `seed`, `frames` and `fps` beside
    the values of the config."""

    def clip(self, index: int) -> Clip:
        """Return clip `index`, a function of `index` and the arguments of the class alone."""
        ...


@runtime_checkable
class Network(Protocol):
    """A network, one's own or frozen; also an `nn.Module`.

    `views`: how many it wants; None: it takes any number.
    """

    views: int | None

    def forward(
        self, voxels: Float[Tensor, "n views bins h w"], state: Any = None
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame at the end of the window, in [0, 1], and the state to go on from.

        With a keyword `window_s` or `positions` it is given the length of the window in seconds
        or the (row, col) of every view; a method `sequence` is given many windows at once and which
        of their frames are wanted (`shown`), `remember` those that are not; see
        `src.models.unroll.unroll`.
        """
        ...


CONTRACTS = {
    "scene": Scene, "turbulence": TurbulenceModel, "sensor": Sensor,
    "model": Network, "baseline": Network,
}  # fmt: skip


def keeping(key: str, made: Any) -> Any:
    """Return `made`, the part `key` of a config; ValueError where it lacks what is asked of it."""
    contract = CONTRACTS.get(key, object)
    if not isinstance(made, contract):
        members = {*vars(contract), *contract.__annotations__} - set(vars(Protocol))
        lacks = sorted(n for n in members if n[0] != "_" and not hasattr(made, n))
        kind = f"{type(made).__module__}.{type(made).__name__}"
        raise ValueError(
            f"{key}._target_ must be a class with {', '.join(lacks)} "
            f"({contract.__module__}.{contract.__name__}), got {kind}"
        )
    return made
