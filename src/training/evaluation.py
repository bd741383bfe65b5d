"""One network on the test clips: scores per clip, cost and latency."""

import lightning
import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import nn

from src.metrics.scores import Scores
from src.models import stopwatch
from src.models.cost import macs, macs_per_frame
from src.models.unroll import video
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
    """Return the row of `network` on the test clips of `data`.

    Raises SIGTERMException when SIGTERM came, which Lightning forgets during the last clip.
    """
    module = Reconstructor(network, {}, scores=scores, warmup=warmup)
    trainer.test(module, data, verbose=False)
    if trainer.received_sigterm:
        raise SIGTERMException
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
    """Return multiply-accumulates and milliseconds of a frame, the first window of the first clip.

    A method that makes a whole video at once is given all of `sample`, and its cost shared out.
    """
    network.eval()
    if not hasattr(network, "video"):
        views, bins, height, width = sample.voxels.shape[2:]
        size = {"views": views, "bins": bins, "positions": sample.positions}
        work = macs_per_frame(network, height, width, **size)
        device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
        window = sample.voxels[:1, 0].to(device)
        how = {"positions": sample.positions, "count": torch.get_num_threads()}
        took = stopwatch.frame(network, window, **how, seconds=0.0, least=5)
        return work, took.median_ms
    now = stopwatch.clock(torch.get_num_threads(), sample.voxels.device)
    frames, start = sample.target.shape[:2].numel(), now()
    video(network, sample)
    seconds = now() - start
    return macs(lambda: video(network, sample)) // frames, 1e3 * seconds / frames
