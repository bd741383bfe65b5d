"""One network on the test clips: scores per clip, cost and latency."""

import time
from dataclasses import dataclass

import lightning
import torch
from torch import nn

from src.data.datamodule import LightFieldData
from src.metrics.scores import Scores
from src.models.cost import macs_per_frame
from src.models.reconstructor import Reconstructor


@dataclass(frozen=True)
class Row:
    """What a line of a table needs: scores of every clip with what was drawn for it, and cost."""

    name: str
    clips: list[dict]
    params: int
    macs_per_frame: int
    latency_ms: dict[str, float]


def test(
    name: str,
    network: nn.Module,
    data: LightFieldData,
    scores: Scores,
    *,
    trainer: lightning.Trainer,
    warmup: int = 0,
) -> Row:
    """Return the row of `network` on the test clips of `data`."""
    module = Reconstructor(network, {}, scores=scores, warmup=warmup)
    trainer.test(module, data, verbose=False)
    views, bins, height, width = module.voxel_shape
    return Row(
        name,
        module.clips,
        params=sum(parameter.numel() for parameter in network.parameters()),
        macs_per_frame=macs_per_frame(network, height, width, views=views, bins=bins),
        latency_ms={f"{height}x{width}": latency_ms(network, height, width, views, bins)},
    )


@torch.no_grad()
def latency_ms(
    network: nn.Module, height: int, width: int, views: int, bins: int, repeats: int = 5
) -> float:
    """Return the median wall time of one frame in ms: batch 1, state carried, after a warm-up."""
    network.eval()
    device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
    voxels = torch.randn(1, views, bins, height, width, device=device)
    _, state = network(voxels, None)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        _, state = network(voxels, state)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(1e3 * (time.perf_counter() - start))
    return sorted(times)[repeats // 2]
