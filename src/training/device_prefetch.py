"""Batches that a thread simulates on the training device while the network trains."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import torch
from torch.utils.data import DataLoader

from src.sim.pipeline import Sample
from src.training.cuda_graphs import CAPTURE_LOCK


class DevicePrefetcher:
    """Yields the batches of `loader`, lists of draws, as samples that `simulate` makes of them.

    One batch is made ahead, in a thread; on a GPU on a stream of its own.  What is raised there is
    raised to the reader.
    """

    def __init__(self, loader: DataLoader, simulate: Callable[[list], Sample]):
        self.loader, self.simulate = loader, simulate

    def __len__(self) -> int:
        return len(self.loader)

    def __iter__(self) -> Iterator[Sample]:
        batches = iter(self.loader)
        stream = torch.cuda.Stream() if torch.cuda.is_available() else None

        def simulate_next() -> tuple[Sample, torch.cuda.Event | None] | None:
            with CAPTURE_LOCK, torch.cuda.stream(stream) if stream else nullcontext():
                batch = next(batches, None)
                if batch is None:
                    return None
                sample = self.simulate(batch)
                return sample, stream.record_event() if stream else None

        with ThreadPoolExecutor(1) as thread:
            ahead = thread.submit(simulate_next)
            while (ready := ahead.result()) is not None:
                ahead = thread.submit(simulate_next)
                yield _take_over(*ready)


def _take_over(sample: Sample, simulated: torch.cuda.Event | None) -> Sample:
    """Return `sample` for use on the current stream, which waits until it is `simulated`."""
    if simulated is not None:
        stream = torch.cuda.current_stream()
        stream.wait_event(simulated)
        for tensor in sample.tensors().values():
            if tensor.is_cuda:
                tensor.record_stream(stream)  # else its memory could be used again too early
    return sample
