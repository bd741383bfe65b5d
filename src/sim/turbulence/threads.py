"""Pieces of work that need nothing of each other, one thread each."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import torch


def in_threads(work: Callable[..., None], pieces: Iterable[tuple]) -> None:
    """Do `work` of every piece, in as many threads as torch has.

    Each piece is computed by one thread, so that its numbers do not depend on how many there are,
    and nobody waits for the cores of another.
    """
    pieces = list(pieces)
    allowed = torch.get_num_threads()
    threads = min(allowed, len(pieces))
    if threads == 1:
        for piece in pieces:
            work(*piece)
        return
    # A thread's own, as is the recording of gradients.
    inference = torch.is_inference_mode_enabled()

    def alone(*piece) -> None:
        with torch.inference_mode(inference), torch.no_grad():
            work(*piece)

    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            for job in [pool.submit(alone, *piece) for piece in pieces]:
                job.result()
    finally:
        torch.set_num_threads(allowed)  # of threads to come: torch lets the last call decide
