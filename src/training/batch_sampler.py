"""Which samples a step is of: numbered batches of two streams, the same after a resume."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from torch.utils.data import Dataset, Sampler

from src.sim.pipeline import Draw, Pipeline


class Item(NamedTuple):
    """Sample `number` of a stream, which shows `clip`; `stream` 0: the usual crops, 1: `large`."""

    clip: int
    number: int
    stream: int = 0

    @property
    def counted(self) -> tuple[int, ...]:
        """What its augmentation is drawn from: the same number in another stream is another."""
        return (self.number,) if self.stream == 0 else (self.stream, self.number)


@dataclass(frozen=True)
class LargeStream:
    """A `share` in [0, 1) of all steps is on `batch_size` clips of `pipeline`, larger pictures: so
    that a network also learns what only a whole frame shows.  Raises ValueError outside of it.
    """

    pipeline: Pipeline
    share: float
    batch_size: int = 1

    def __post_init__(self):
        if not 0 <= self.share < 1:
            raise ValueError(f"data.large.share must be in [0, 1), got {self.share}")


class Numbered(Dataset):
    """The draws of pipelines, one for each stream."""

    def __init__(self, *streams: Pipeline):
        self.streams = streams

    def __getitem__(self, item: Item) -> tuple[Item, Draw]:
        return item, self.streams[item.stream].draw(item.clip)


@dataclass(eq=False)
class StepSampler(Sampler[list[Item]]):
    """The batch of step s: numbers s * size .. (s + 1) * size - 1.

    The clips are those of step s // reuse * reuse.  Starts at the step reached; an epoch ends when
    the step is a multiple of `steps_per_epoch`.  With several processes each takes its own slice of
    the joint batch, so that no two simulate the same clip.  `large` = (share, size): so many steps,
    evenly spread, are of stream 1, which counts its own.
    """

    batch_size: int
    steps_per_epoch: int
    step: Callable[[], int]
    reuse: int = field(default=1, kw_only=True)
    rank: int = field(default=0, kw_only=True)
    world: int = field(default=1, kw_only=True)
    large: tuple[float, int] = field(default=(0.0, 1), kw_only=True)

    def __len__(self) -> int:
        return self.steps_per_epoch

    def __iter__(self) -> Iterator[list[Item]]:
        first = self.step()
        for step in range(first, (first // self.steps_per_epoch + 1) * self.steps_per_epoch):
            yield self.batch(step)

    def batch(self, step: int) -> list[Item]:
        """Return what is trained on in `step`."""
        share, size = self.large
        made, part = step // self.reuse, step % self.reuse  # simulated batch, and how often used
        before, after = int(made * share), int((made + 1) * share)
        stream, size = (1, size) if after > before else (0, self.batch_size)
        first = made if stream == 0 else before
        clips = self._numbers(first * self.reuse, size)
        numbers = self._numbers(first * self.reuse + part, size)
        return [Item(*pair, stream) for pair in zip(clips, numbers, strict=True)]

    def _numbers(self, step: int, size: int) -> range:
        start = (step * self.world + self.rank) * size
        return range(start, start + size)
