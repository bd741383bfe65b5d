"""Teacher networks, whose mean frame is a second target in training (Hinton et al. 2015,
Distilling the knowledge in a neural network): it is closer to the truth than any of them.
"""

import hashlib
import math
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

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
    of the networks and the sample.  Raises ValueError, naming `teachers`, where no network takes
    one of `required_rates_hz`.
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
        self.hashes = {name: _hash_network(net) for name, net in networks.items()}
        self.paths: dict[Hashable, Path] = {}

    def __call__(self, sample: Sample, key: Hashable = None) -> Float[Tensor, "1 windows 1 h w"]:
        """Return the mean frames of a single clip, in [0, 1]; a sample whose `key` comes again is
        not hashed again, one without a key does not come again and is not stored.
        """
        names = self._names_at(1 / float(sample.window_s[0]))
        frames = self._mean_frames(sample, names) if key is None else self._kept(sample, names, key)
        return frames.to(sample.voxels.device).float() / LEVELS

    def _kept(self, sample: Sample, names: list[str], key: Hashable) -> UInt8[Tensor, "..."]:
        if key not in self.paths:
            inputs = _hash(sample.voxels, sample.window_s, torch.tensor(sample.positions or ()))
            text = "".join(sorted(self.hashes[name] for name in names)) + inputs
            name = hashlib.sha256(text.encode()).hexdigest()[:24]
            self.paths[key] = self.cache / f"{name}.pt"
        path = self.paths[key]
        if path.exists() and is_intact(path):
            return torch.load(path, weights_only=True)["pictures"]
        frames = self._mean_frames(sample, names).cpu()
        path.parent.mkdir(parents=True, exist_ok=True)
        save_atomically({"pictures": frames}, path)
        return frames

    def _names_at(self, rate: float) -> list[str]:
        """Return the names of the networks that teach at `rate` windows a second."""
        is_usual = math.isclose(rate, self.trained_rate_hz, rel_tol=1e-3)
        return [name for name, net in self.networks.items() if is_usual or net.uses_window_length]

    @torch.no_grad()
    def _mean_frames(self, sample: Sample, names: list[str]) -> UInt8[Tensor, "..."]:
        device = sample.voxels.device
        half = device.type != "cpu" or is_bf16_faster()
        with torch.autocast(device.type, torch.bfloat16, enabled=half):
            networks = (self.networks[name].to(device) for name in names)
            videos = [network.reconstruct_clip(sample).float() for network in networks]
        return (LEVELS * torch.stack(videos).mean(0).clamp(0, 1)).round().to(torch.uint8)


def _hash_network(network: nn.Module) -> str:
    """Return a hash of the weights, and of the classes and plain attributes of all parts."""
    parts = [
        (name, type(part).__qualname__, [(key, _plain(value)) for key, value in vars(part).items()])
        for name, part in network.named_modules()
    ]
    return _hash(*network.state_dict().values(), text=repr(parts))


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return getattr(value, "__qualname__", type(value).__qualname__)  # functions have names


def _hash(*tensors: Tensor, text: str = "") -> str:
    digest = hashlib.sha256(text.encode())
    for tensor in tensors:
        digest.update(str(tensor.dtype).encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()
