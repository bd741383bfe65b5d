"""Batches that are simulated one ahead, in a thread."""

import gc
import multiprocessing
import threading

import pytest
import torch
from lightning.pytorch.utilities.combined_loader import _shutdown_workers_and_reset_iterator
from torch.utils.data import DataLoader

from src.sim.pipeline import Sample
from src.training.cuda_graphs import CAPTURE_LOCK
from src.training.device_prefetch import DevicePrefetcher


def prefetcher(batches: int, simulate, device: str = "cpu", **loading) -> DevicePrefetcher:
    loader = DataLoader(range(batches), collate_fn=list, **loading)
    return DevicePrefetcher(loader, simulate, torch.device(device))


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

    ahead = prefetcher(4, simulate)
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
    batches = iter(prefetcher(2, simulate))
    assert number(next(batches)) == 0
    with pytest.raises(ValueError, match="no clip"):
        next(batches)
    assert threading.active_count() == before


def test_a_reader_that_stops_early_leaves_no_thread():
    before = threading.active_count()
    batches = iter(prefetcher(9, lambda batch: sample(batch[0])))
    next(batches)
    batches.close()
    assert threading.active_count() == before


def test_nothing_is_simulated_during_a_capture():
    is_made = threading.Event()

    def simulate(batch: list) -> Sample:
        is_made.set()
        return sample(batch[0])

    reader = threading.Thread(target=lambda: list(prefetcher(1, simulate)))
    with CAPTURE_LOCK:
        reader.start()
        assert not is_made.wait(0.3)
    reader.join(10)
    assert is_made.is_set() and not reader.is_alive()


def test_processes_that_draw_end_with_the_training():
    ahead = prefetcher(
        3, lambda batch: sample(int(batch[0])), num_workers=1, persistent_workers=True
    )
    assert [number(batch) for batch in ahead] == [0, 1, 2]
    _shutdown_workers_and_reset_iterator(ahead)
    gc.collect()
    assert ahead.loader._iterator is None and not multiprocessing.active_children()


@pytest.mark.gpu
def test_on_a_gpu_batches_are_whole_when_they_are_used():
    def simulate(batch: list) -> Sample:
        slow = torch.ones(4096, 4096, device="cuda")
        for _ in range(20):
            slow = slow @ slow / 4096
        frame = slow[None, None, None]
        return Sample(slow[None, None, None, None] * batch[0], frame, frame, slow[0, :1])

    for k, batch in enumerate(prefetcher(6, simulate, "cuda")):
        assert bool((batch.voxels == k).all())
