"""Batches that a thread simulates on the training device while the network trains."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any

import torch
from torch.utils.data import DataLoader

from src.sim.pipeline import Sample
from src.training.cuda_graphs import CAPTURE_LOCK


class DevicePrefetcher:
    """Yields the batches of `loader`, lists of draws, as samples that `simulate` makes of them.

    One batch is made ahead, in a thread; on a GPU on a stream of its own.  What is raised there is
    raised to the reader.  `device`: on which `simulate` computes.
    """

    def __init__(
        self, loader: DataLoader, simulate: Callable[[list], Sample], device: torch.device
    ):
        self.loader, self.simulate, self.device = loader, simulate, device
        self.stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    def __len__(self) -> int:
        return len(self.loader)

    def __iter__(self) -> Iterator[Sample]:
        batches, stream = iter(self.loader), self.stream

        def simulate_next() -> tuple[Sample, torch.cuda.Event | None] | None:
            with CAPTURE_LOCK, torch.cuda.stream(stream) if stream else nullcontext():
                batch = next(batches, None)
                if batch is None:
                    return None
                sample = self.simulate(batch)
                return sample, stream.record_event() if stream else None

        with ThreadPoolExecutor(1, initializer=self._select_device) as thread:
            ahead = thread.submit(simulate_next)
            while (ready := ahead.result()) is not None:
                ahead = thread.submit(simulate_next)
                yield _take_over(*ready)

    def _select_device(self) -> None:
        if self.stream is not None:  # a new thread has the first GPU
            torch.cuda.set_device(self.device)

    @property
    def _iterator(self) -> Any:
        """The iterator of `loader`, by which Lightning ends its workers."""
        return self.loader._iterator

    @_iterator.setter
    def _iterator(self, iterator: Any) -> None:
        self.loader._iterator = iterator


def _take_over(sample: Sample, simulated: torch.cuda.Event | None) -> Sample:
    """Return `sample` for use on the current stream, which waits until it is `simulated`."""
    if simulated is not None:
        stream = torch.cuda.current_stream()
        stream.wait_event(simulated)
        for tensor in sample.tensors().values():
            if tensor.is_cuda:
                tensor.record_stream(stream)  # else its memory could be used again too early
    return sample
