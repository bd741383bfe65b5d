"""Teacher networks, whose mean frame is a second target in training (Hinton et al. 2015,
Distilling the knowledge in a neural network): it is closer to the truth than any of them.
"""

import hashlib
import math
from collections.abc import Hashable, Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from src.deploy.cpu_features import is_bf16_faster
from src.models.checkpoints import is_intact, save_atomically
from src.models.network import EventToVideoNetwork
from src.sim.pipeline import Sample

LEVELS = 255  # of a cached frame


class TeacherEnsemble:
    """The `networks`, by name, all of which take the views of the samples.

    One without `uses_window_length` teaches windows of 1 / `trained_rate_hz` seconds only, as it
    was trained with.  `cache`: a folder for their frames, 8 bits a pixel, so that a sample that
    comes again, in this training or another, is not reconstructed again; files are named by a hash
    of the weights and the sample.  Raises ValueError, naming `teachers`, where no network takes one
    of `required_rates_hz`.
    """

    def __init__(
        self,
        networks: Mapping[str, EventToVideoNetwork],
        cache: str | Path,
        trained_rate_hz: float,
        required_rates_hz: tuple[float, ...] = (),
    ):
        self.networks = {name: net.eval() for name, net in networks.items()}
        self.cache, self.trained_rate_hz = Path(cache), trained_rate_hz
        for other in required_rates_hz:
            if not self._names_at(other):
                raise ValueError(
                    f"teachers must have one that takes windows of any length, as a SetNet does, "
                    f"for {other:g} windows a second, got {', '.join(networks)}"
                )
        self.hashes = {name: _hash(*net.state_dict().values()) for name, net in networks.items()}
        self.paths: dict[Hashable, Path] = {}

    def __call__(self, sample: Sample, key: Hashable = None) -> Float[Tensor, "1 windows 1 h w"]:
        """Return the mean frames of a single clip, in [0, 1]; a sample whose `key` comes again is
        not hashed again.
        """
        names = self._names_at(1 / float(sample.window_s[0]))
        path = self.paths.get(key)
        if path is None:
            inputs = _hash(sample.voxels, sample.window_s, torch.tensor(sample.positions or ()))
            text = "".join(sorted(self.hashes[name] for name in names)) + inputs
            path = self.cache / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.pt"
        if key is not None:
            self.paths[key] = path
        if path.exists() and is_intact(path):
            frames = torch.load(path, weights_only=True)["pictures"]
        else:
            frames = (LEVELS * self._mean_frames(sample, names)).round().to("cpu", torch.uint8)
            path.parent.mkdir(parents=True, exist_ok=True)
            save_atomically({"pictures": frames}, path)
        return frames.to(sample.voxels.device).float() / LEVELS

    def _names_at(self, rate: float) -> list[str]:
        """Return the names of the networks that teach at `rate` windows a second."""
        is_usual = math.isclose(rate, self.trained_rate_hz, rel_tol=1e-3)
        return [name for name, net in self.networks.items() if is_usual or net.uses_window_length]

    @torch.no_grad()
    def _mean_frames(self, sample: Sample, names: list[str]) -> Tensor:
        device = sample.voxels.device
        half = device.type != "cpu" or is_bf16_faster()
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            networks = (self.networks[name].to(device) for name in names)
            videos = [network.reconstruct_clip(sample).float() for network in networks]
        return torch.stack(videos).mean(0).clamp(0, 1)


def _hash(*tensors: Tensor) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()
