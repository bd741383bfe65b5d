"""Frozen networks that teach another: the mean of their pictures, a second target in training.

Each network errs in its own way in what the events leave open; the mean of several is closer to the
truth than any of them, at the cost of all.  A network learns it at its own cost (Hinton et al.
2015, Distilling the knowledge in a neural network).
"""

import hashlib
import math
from collections.abc import Hashable, Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.models.checkpoints import WholeFiles, whole
from src.models.fast import computes_bf16
from src.models.unroll import takes, video
from src.sim.pipeline import Sample

LEVELS = 255  # of a picture that is kept


class Teachers:
    """The `networks`, by name, all of which take the views of the samples.

    One that is not told how long a window lasts teaches windows of 1 / `rate` seconds only, as it
    was trained with.  `root`: a folder for their pictures, 8 bits a pixel: a sample that comes
    again, in this training or another, is not reconstructed again.  Files are named by what is in
    the networks and the sample, so that none is ever stale.  Raises ValueError, naming `teachers`,
    where no network is told how long a window lasts but `rates` has others.
    """

    def __init__(
        self,
        networks: Mapping[str, nn.Module],
        root: str | Path,
        rate: float,
        rates: tuple[float, ...] = (),
    ):
        self.networks = {name: net.eval() for name, net in networks.items()}
        self.root, self.rate = Path(root), rate
        for other in rates:
            if not self._for(other):
                raise ValueError(
                    f"teachers must have one that is told how long a window lasts, as a SetNet is, "
                    f"for {other:g} windows a second, got {', '.join(networks)}"
                )
        self.names = {name: _digest(*net.state_dict().values()) for name, net in networks.items()}
        self.paths: dict[Hashable, Path] = {}

    def __call__(self, sample: Sample, name: Hashable = None) -> Float[Tensor, "1 windows 1 h w"]:
        """Return the mean picture of a single clip, in [0, 1].

        `name` tells the sample from all others that are given here (None: nothing does): one that
        comes again is not hashed again.
        """
        chosen = self._for(1 / float(sample.window_s[0]))
        path = self.paths.get(name) or self._path(sample, chosen)
        if name is not None:
            self.paths[name] = path
        if path.exists() and whole(path):
            kept = torch.load(path, weights_only=True)["pictures"]
        else:
            kept = (LEVELS * self._mean(sample, chosen)).round().to("cpu", torch.uint8)
            path.parent.mkdir(parents=True, exist_ok=True)
            WholeFiles().save_checkpoint({"pictures": kept}, path)
        return kept.to(sample.voxels.device).float() / LEVELS

    def _path(self, sample: Sample, chosen: list[str]) -> Path:
        """Return the file of what the networks `chosen` make of a sample."""
        known = _digest(sample.voxels, sample.window_s, torch.tensor(sample.positions or ()))
        names = "".join(sorted(self.names[name] for name in chosen))
        return self.root / f"{hashlib.sha256((names + known).encode()).hexdigest()[:24]}.pt"

    def _for(self, rate: float) -> list[str]:
        """Return the names of the networks that teach at `rate` windows a second."""
        usual = math.isclose(rate, self.rate, rel_tol=1e-3)
        return [name for name, net in self.networks.items() if usual or takes(net, "window_s")]

    @torch.no_grad()
    def _mean(self, sample: Sample, names: list[str]) -> Tensor:
        kind = sample.voxels.device.type
        half = kind != "cpu" or computes_bf16()
        with torch.autocast(kind, torch.bfloat16, enabled=half):
            networks = (self.networks[name].to(sample.voxels.device) for name in names)
            videos = [video(network, sample).float() for network in networks]
        return torch.stack(videos).mean(0).clamp(0, 1)


def _digest(*tensors: Tensor) -> str:
    """Return a hash of the values of tensors."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()
