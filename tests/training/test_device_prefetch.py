"""Batches that are simulated one ahead, in a thread."""

import threading

import pytest
import torch
from torch.utils.data import DataLoader

from src.sim.pipeline import Sample
from src.training.cuda_graphs import CAPTURE_LOCK
from src.training.device_prefetch import DevicePrefetcher


def draws(batches: int) -> DataLoader:
    return DataLoader(range(batches), collate_fn=list)


def sample(number: int) -> Sample:
    frame = torch.zeros(1, 1, 1, 1, 1)
    return Sample(torch.full((1, 1, 1, 1, 1, 1), float(number)), frame, frame, torch.ones(1))


def number(batch: Sample) -> int:
    return int(batch.voxels)


def test_the_next_batch_is_made_while_the_one_before_is_used():
    made, threads = [], set()
    is_made = [threading.Event() for _ in range(4)]

    def simulate(batch: list) -> Sample:
        made.append(batch[0])
        threads.add(threading.current_thread())
        is_made[batch[0]].set()
        return sample(batch[0])

    ahead = DevicePrefetcher(draws(4), simulate)
    assert len(ahead) == 4
    for k, batch in enumerate(ahead):
        assert number(batch) == k
        if k < 3:
            assert is_made[k + 1].wait(10)
        assert made == list(range(min(k + 2, 4)))  # one ahead, no more
    assert len(threads) == 1 and threading.current_thread() not in threads


def test_what_is_raised_reaches_the_reader_and_the_thread_ends():
    def simulate(batch: list) -> Sample:
        if batch[0] == 1:
            raise ValueError("no clip")
        return sample(batch[0])

    before = threading.active_count()
    batches = iter(DevicePrefetcher(draws(2), simulate))
    assert number(next(batches)) == 0
    with pytest.raises(ValueError, match="no clip"):
        next(batches)
    assert threading.active_count() == before


def test_a_reader_that_stops_early_leaves_no_thread():
    before = threading.active_count()
    batches = iter(DevicePrefetcher(draws(9), lambda batch: sample(batch[0])))
    next(batches)
    batches.close()
    assert threading.active_count() == before


def test_nothing_is_simulated_during_a_capture():
    is_made = threading.Event()

    def simulate(batch: list) -> Sample:
        is_made.set()
        return sample(batch[0])

    reader = threading.Thread(target=lambda: list(DevicePrefetcher(draws(1), simulate)))
    with CAPTURE_LOCK:
        reader.start()
        assert not is_made.wait(0.3)
    reader.join(10)
    assert is_made.is_set() and not reader.is_alive()


@pytest.mark.gpu
def test_on_a_gpu_batches_are_whole_when_they_are_used():
    def simulate(batch: list) -> Sample:
        slow = torch.ones(4096, 4096, device="cuda")
        for _ in range(20):
            slow = slow @ slow / 4096
        frame = slow[None, None, None]
        return Sample(slow[None, None, None, None] * batch[0], frame, frame, slow[0, :1])

    for k, batch in enumerate(DevicePrefetcher(draws(6), simulate)):
        assert bool((batch.voxels == k).all())
