"""One network on the test clips: scores per clip, cost and latency."""

import lightning
import torch
from torch import nn

from src.metrics.scores import Scores
from src.models.cost import clock, macs, macs_per_frame
from src.models.unroll import accepted, video
from src.records.results import Row
from src.sim.pipeline import Sample
from src.training.datamodule import LightFieldData
from src.training.reconstructor import Reconstructor


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
    macs_of_frame, milliseconds = cost(network, module.sample)
    height, width = module.sample.target.shape[-2:]
    return Row(
        name,
        module.clips,
        params=sum(parameter.numel() for parameter in network.parameters()),
        macs_per_frame=macs_of_frame,
        latency_ms={f"{height}x{width}": milliseconds},
    )


@torch.no_grad()
def cost(network: nn.Module, sample: Sample) -> tuple[int, float]:
    """Return multiply-accumulates and milliseconds of one frame.

    A method that makes a whole video at once is given all of `sample`, and its cost shared out.
    """
    if not hasattr(network, "video"):
        views, bins, height, width = sample.voxels.shape[2:]
        size = {"views": views, "bins": bins, "positions": sample.positions}
        return macs_per_frame(network, height, width, **size), latency_ms(network, sample)
    now = clock(torch.get_num_threads(), sample.voxels.device)
    frames, start = sample.target.shape[:2].numel(), now()
    video(network, sample)
    seconds = now() - start
    return macs(lambda: video(network, sample)) // frames, 1e3 * seconds / frames


@torch.no_grad()
def latency_ms(network: nn.Module, sample: Sample, repeats: int = 5) -> float:
    """Return the median time of one frame in ms: the first window of the first clip, state carried,
    after a warm-up.
    """
    network.eval()
    device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
    voxels, now = sample.voxels[:1, 0].to(device), clock(torch.get_num_threads(), device)
    options = accepted(network, positions=sample.positions)
    _, state = network(voxels, None, **options)
    times = []
    for _ in range(repeats):
        start = now()
        _, state = network(voxels, state, **options)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(1e3 * (now() - start))
    return sorted(times)[repeats // 2]
