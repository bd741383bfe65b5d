"""Simulated test clips that stay in memory for the next network that is tested on the same."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from src.sim.pipeline import Sample
from src.training.batch_sampler import SampleId

LIMIT = 2 * 2**30  # bytes; twelve clips of 40 windows, nine views of 128x128 and one, take 1.6e9


@dataclass
class SampleStore:
    """Samples by the conditions that they follow from and their number, `limit` bytes at most.

    Those of other conditions make room, the oldest first; what does not fit then is not kept.
    """

    limit: int = LIMIT
    samples: dict[str, dict[SampleId, Sample]] = field(default_factory=dict)

    def get(self, conditions: str, sample_id: SampleId) -> Sample | None:
        """Return a sample, or None where it is not kept."""
        return self.samples.get(conditions, {}).get(sample_id)

    def add(self, conditions: str, sample_id: SampleId, sample: Sample) -> None:
        """Keep a sample where there is room."""
        size = count_bytes(sample)
        for other in [other for other in self.samples if other != conditions]:
            if self.count_bytes() + size > self.limit:
                del self.samples[other]
        if self.count_bytes() + size <= self.limit:
            self.samples.setdefault(conditions, {})[sample_id] = sample

    def count_bytes(self) -> int:
        """Return the bytes of all samples."""
        return sum(count_bytes(one) for kept in self.samples.values() for one in kept.values())


@dataclass(frozen=True)
class StoredSamples:
    """The samples `ids` in their order: out of `store`, or simulated and then kept there.

    `simulate` returns those of a list of ids, one after the other; where it returns anything but
    samples, such as draws for a device to simulate, nothing is kept.
    """

    ids: Sequence[SampleId]
    conditions: str
    store: SampleStore
    simulate: Callable[[list[SampleId]], Iterable]

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[Sample]:
        kept = [self.store.get(self.conditions, sample_id) for sample_id in self.ids]
        missing = [n for n, sample in zip(self.ids, kept, strict=True) if sample is None]
        fresh = iter(self.simulate(missing)) if missing else iter(())
        for sample_id, sample in zip(self.ids, kept, strict=True):
            if sample is None:
                sample = next(fresh)
                if isinstance(sample, Sample):
                    self.store.add(self.conditions, sample_id, sample)
            yield sample


def count_bytes(sample: Sample) -> int:
    """Return the bytes of a sample's tensors."""
    return sum(tensor.nbytes for tensor in sample.tensors().values())
