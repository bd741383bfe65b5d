"""Which samples a step is of: numbered batches of two streams, the same after a resume."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from torch.utils.data import Dataset, Sampler

from src.sim.pipeline import ClipParameters, Pipeline


class SampleId(NamedTuple):
    """Sample `number` of a stream, of clip `clip`.  `crop_stream` 0: usual, 1: `data.large`."""

    clip: int
    number: int
    crop_stream: int = 0

    @property
    def augmentation_key(self) -> tuple[int, ...]:
        """What its augmentation is drawn from: the same number in another stream is another."""
        return (self.number,) if self.crop_stream == 0 else (self.crop_stream, self.number)


@dataclass(frozen=True)
class LargeCropStream:
    """A `share` in [0, 1) of all steps is on `batch_size` clips of `pipeline`, larger frames.

    Raises ValueError for another share.
    """

    pipeline: Pipeline
    share: float
    batch_size: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise ValueError(f"data.large.share must be in [0, 1), got {self.share}")


class DrawDataset(Dataset):
    """The draws of pipelines, one for each stream."""

    def __init__(self, *streams: Pipeline):
        self.streams = streams

    def __getitem__(self, sample: SampleId) -> tuple[SampleId, ClipParameters]:
        return sample, self.streams[sample.crop_stream].draw(sample.clip)


@dataclass(eq=False, kw_only=True)
class StepSampler(Sampler[list[SampleId]]):
    """The batch of step s: numbers s * size .. (s + 1) * size - 1.

    `batch_reuse` steps in a row are of the same clips, which are numbered on from one simulation to
    the next.  Starts at the step reached; an epoch ends when the step is a multiple of
    `steps_per_epoch`.  With `world` processes each takes its own slice of the joint batch.  A
    `large_share` of the steps, evenly spread, are `large_batch_size` samples of stream 1, which
    counts its own.
    """

    batch_size: int
    steps_per_epoch: int
    current_step: Callable[[], int]
    batch_reuse: int = 1
    rank: int = 0
    world: int = 1
    large_share: float = 0.0
    large_batch_size: int = 1

    def __len__(self) -> int:
        return self.steps_per_epoch

    def __iter__(self) -> Iterator[list[SampleId]]:
        first = self.current_step()
        for step in range(first, (first // self.steps_per_epoch + 1) * self.steps_per_epoch):
            yield self.batch(step)

    def batch(self, step: int) -> list[SampleId]:
        """Return the samples of `step`."""
        simulation, use = divmod(step, self.batch_reuse)
        large = int(simulation * self.large_share)  # simulations of stream 1 before this one
        stream = int((simulation + 1) * self.large_share) - large
        simulation = large if stream else simulation  # of this stream
        size = self.large_batch_size if stream else self.batch_size
        clip, number = (
            (count * self.world + self.rank) * size
            for count in (simulation, simulation * self.batch_reuse + use)
        )
        return [SampleId(clip + k, number + k, stream) for k in range(size)]
