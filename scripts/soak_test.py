"""What grows in a long run:

    python -m scripts.soak_test train 60
    python -m scripts.soak_test events 2e7

`train` trains the smallest network for so many minutes, with a worker, validations and checkpoints
every few steps; `events` reconstructs so many events, a recording over and over.  Memory and open
files, of the process and its workers, are looked at every second; printed is their slope over the
last two thirds, which leaves out what caches take at first.
"""

import argparse
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
import torch

from src.app import build, entry_point
from src.app.compose import compose_config
from src.app.script import run_script
from src.models.e2vid import E2VID
from src.recordings import event_windows, output, reconstruction, sensor_lookup
from src.recordings.files import event_file, event_writers, recording_inputs
from src.recordings.views import Views
from src.records import results
from src.train import fit

SMALL = ["debug=fdr", "loss=l1", "metrics.lpips=null", "logger=csv"]
SMALL += ["trainer.enable_progress_bar=false"]
SMALL += ["data.workers=1", "data.epoch_clips=40", "data.batch_reuse=1"]
SMALL += ["trainer.max_steps=-1", "scheduler=null"]
SIDE, EVENTS = 64, 200_000  # of the recording: pixels, events in 2 s


class Watch:
    """Looks at memory (MiB) and open files every second while its block runs."""

    def __enter__(self) -> "Watch":
        self.seen: list[tuple[float, float, int]] = []
        self.over = threading.Event()
        self.thread = threading.Thread(target=self._look, daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *error) -> None:
        self.over.set()
        self.thread.join()

    def _look(self) -> None:
        start = time.monotonic()
        while not self.over.wait(1.0):
            family = [os.getpid(), *_children(os.getpid())]
            held, files = sum(map(_memory, family)), sum(map(_files, family))
            self.seen.append((time.monotonic() - start, held, files))

    def slope(self) -> dict:
        """Return what grew per hour (least squares), and the most that was held."""
        late = np.array(self.seen[len(self.seen) // 3 :])
        memory, files = (np.polyfit(late[:, 0], late[:, k], 1)[0] * 3600 for k in (1, 2))
        return {
            "seconds": round(self.seen[-1][0]),
            "MiB per hour": round(float(memory), 1),
            "MiB at most": round(float(late[:, 1].max())),
            "open files per hour": round(float(files), 1),
            "open files at most": int(late[:, 2].max()),
        }


def _children(pid: int) -> list[int]:
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except OSError:
        return []
    found = [int(word) for word in text.split()]
    return found + [grandchild for child in found for grandchild in _children(child)]


def _memory(pid: int) -> float:
    """Return the resident memory that the process shares with nobody, in MiB."""
    try:
        words = Path(f"/proc/{pid}/statm").read_text().split()
    except OSError:
        return 0.0
    return (int(words[1]) - int(words[2])) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _files(pid: int) -> int:
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return 0


def train(minutes: float, run: Path) -> dict:
    """Train for `minutes`; returns the slopes and the number of steps."""
    limit = f"+trainer.max_time={{minutes: {minutes}}}"
    cfg = compose_config("train", *SMALL, limit, f"paths.run={run}")
    network, spec = build.build_untrained_network(cfg)
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    trainer = build.build_trainer(cfg)
    module, data = build.build_reconstructor(cfg, network, spec), build.build_data_module(cfg)
    with Watch() as watch:
        fit(trainer, module, data, None)
    return watch.slope() | {"steps": trainer.global_step}


def reconstruct(events: int, run: Path) -> dict:
    """Reconstruct `events` events, the same recording again and again; returns the slopes."""
    path, views = run / "cap.raw", Views.single_view((SIDE, SIDE), (SIDE, SIDE))
    event_writers.write_events(path, _recording(), width=SIDE, height=SIDE)
    network = E2VID(views=1, base_channels=4).eval()
    chunks = _over_and_over(path, events)
    windows = event_windows.cut_windows(
        chunks, sensor_lookup.build_lookup(views), event_windows.WindowRule(fps=120.0)
    )
    with Watch() as watch, output.open_video_writer("hdf5", run, views.model) as write:
        for frame in reconstruction.reconstruct_frames(windows, network):
            write(frame)
    return watch.slope() | {"events": events}


def _recording() -> np.ndarray:
    draw = np.random.default_rng(0)
    made = np.zeros(EVENTS, event_file.EVENT)
    made["t"] = np.sort(draw.integers(0, 2_000_000, EVENTS))
    made["x"], made["y"] = draw.integers(0, SIDE, (2, EVENTS))
    made["p"] = draw.choice([-1, 1], EVENTS)
    return made


def _over_and_over(path: Path, events: int) -> Iterator[np.ndarray]:
    for turn in count():
        if turn * EVENTS >= events:
            return
        for chunk in recording_inputs.iter_recording(path, (SIDE, SIDE)):
            chunk["t"] += turn * 2_000_000
            yield chunk


def main() -> None:
    """Do what the command line says and print what grew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=["train", "events"])
    parser.add_argument("amount", type=float, help="minutes of training, or events")
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as run:
        if given.kind == "train":
            found = train(given.amount, Path(run))
        else:
            found = reconstruct(int(given.amount), Path(run))
    print(", ".join(f"{name} {value}" for name, value in found.items()))


if __name__ == "__main__":
    run_script(main)
