"""One network on the test clips: scores per clip, cost and latency."""

from collections.abc import Sequence

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor

from src.deploy.cost import count_macs, macs_per_frame, select_timing_clock, time_frame
from src.metrics.video_metrics import VideoMetrics
from src.models.network import EventToVideoNetwork, VideoMethod
from src.records.results import ScoreRow
from src.sim.optics import Position
from src.sim.pipeline import Sample
from src.training.datamodule import LightFieldData
from src.training.reconstructor import Reconstructor


def test_network(
    name: str, network: VideoMethod, data: LightFieldData, metrics: VideoMetrics, *,
    trainer: lightning.Trainer, unscored_windows: int = 0, kept_clips: int = 0,
) -> tuple[ScoreRow, list[tuple[Sample, Tensor]]]:  # fmt: skip
    """Return the row of `network` on the test clips of `data`, and the first `kept_clips` of them,
    each with its reconstruction.

    Raises SIGTERMException when SIGTERM came, which Lightning forgets during the last clip.
    """
    module = Reconstructor(
        network, {}, metrics=metrics, unscored_windows=unscored_windows, kept_clips=kept_clips
    )
    trainer.test(module, data, verbose=False)
    if trainer.received_sigterm:
        raise SIGTERMException
    macs_of_frame, milliseconds = measure_macs_and_ms(network, module.sample)
    height, width = module.sample.target.shape[-2:]
    row = ScoreRow(
        name,
        module.clips,
        params=sum(parameter.numel() for parameter in network.parameters()),
        macs_per_frame=macs_of_frame,
        latency_ms_by_size={f"{height}x{width}": milliseconds},
        own_metrics=metrics.user_metric_columns,
    )
    return row, module.reconstructions


@torch.no_grad()
def measure_macs_and_ms(network: VideoMethod, sample: Sample) -> tuple[int, float]:
    """Return multiply-accumulates and milliseconds of a frame, the first window of `sample`, on its
    device, on which `network` then stays.

    A method that makes a whole video at once is given all of `sample`, and its cost shared out.
    """
    device, threads = sample.voxels.device, torch.get_num_threads()
    network.eval().to(device)  # Lightning moves it to the CPU after a test
    if isinstance(network, EventToVideoNetwork):
        return measure_frame_macs_and_ms(network, sample.voxels[:1, 0], sample.positions)
    now = select_timing_clock(threads, device)
    frames, start = sample.target.shape[:2].numel(), now()
    network.reconstruct_clip(sample)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    seconds = now() - start
    return count_macs(lambda: network.reconstruct_clip(sample)) // frames, 1e3 * seconds / frames


@torch.no_grad()
def measure_frame_macs_and_ms(
    network: EventToVideoNetwork, window: Float[Tensor, "1 views bins h w"],
    positions: Sequence[Position] | None = None,
) -> tuple[int, float]:  # fmt: skip
    """Return multiply-accumulates and milliseconds, the least of five times, of the frame of a
    `window`, on its device."""
    views, bins, height, width = window.shape[1:]
    macs = macs_per_frame(network, height, width, views=views, bins=bins, positions=positions)
    timing = time_frame(network, window, positions=positions, threads=torch.get_num_threads())
    return macs, timing.least_ms
