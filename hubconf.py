"""Shipped networks for code of one's own, without the rest of the repository:

    net = torch.hub.load("<folder of this repository>", "setnet_small", source="local")
    with torch.inference_mode():  # without it the state keeps the graph of all windows
        frame, state = net(voxels, state)

`voxels` (n, views, bins, h, w): sums of polarity in `bins` hat functions over a window
(docs/conventions.md); `frame` (n, 1, h, w) in [0, 1]; `state` None starts a sequence.  The networks
are float32 and in eval mode.  What each was trained and tested on: weights/<name>.md.
"""

from torch import nn

from src.models import files

dependencies = ["torch", "numpy", "jaxtyping", "safetensors"]


def setnet_small() -> nn.Module:
    """Any number of views at any rate; 0.34 GMAC a frame of 176 x 176 with nine views.

    Takes `window_s`, the length of a window in seconds (1/120), and `positions`, the (row, col) of
    every view.
    """
    return files.load("setnet_small")


def setnet_medium() -> nn.Module:
    """As `setnet_small`, 1.2 GMAC."""
    return files.load("setnet_medium")


def setnet_large() -> nn.Module:
    """As `setnet_small`, 3.5 GMAC."""
    return files.load("setnet_large")


def lf3x3() -> nn.Module:
    """E2VID with the nine views of a 3x3 light field stacked, row by row (the paper's)."""
    return files.load("lf3x3")


def single256() -> nn.Module:
    """E2VID of one view, trained through turbulence (the paper's baseline)."""
    return files.load("single256")


def network(name: str) -> nn.Module:
    """The network of a name in weights/, such as clean/etnet, or of a path; ValueError for none."""
    return files.load(name)
