"""How a process behaves that works for another one."""

import multiprocessing
import os
import signal
import threading

import torch


def prepare_worker_process(worker: int = 0) -> None:
    """Let this process, of any number, compute in one thread, leave Ctrl-C, which a terminal sends
    to all, to its parent and end with it.
    """
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    exit_with_parent()


def exit_with_parent() -> None:
    """End this process, which another one started, as soon as that one has ended in any way."""
    threading.Thread(target=_exit_after_parent, daemon=True).start()


def _exit_after_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
