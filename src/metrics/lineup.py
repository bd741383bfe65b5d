"""The networks that are compared: what each is called, which views it is given, what is missing."""

from dataclasses import dataclass

from torch import nn


@dataclass(frozen=True)
class Candidate:
    """A line of the chart or a column of the stress map.

    `views`: how many views of the light field it is given (1: the centre view).  `trained`: its
    weights are here; without them only speed means anything.  `missing`: why there is no network at
    all, in plain words.
    """

    name: str
    network: nn.Module | None
    views: int
    trained: bool = True
    missing: str = ""
