"""Fill a pre-simulated turbulence cache before the trainings that use it, with their config:

    python -m scripts.fill_cache experiment=lf3x3 data.cache_clips=1500 scene.root=... [+workers=2]

That of data.large is filled first.  `+device=cuda`: a GPU computes the pixels of what `workers`
processes draw.  Stopped anywhere and started again it goes on; trainings may use it meanwhile.
"""

import multiprocessing
import time

import hydra
import torch
from omegaconf import DictConfig

from src.app import entry_point, simulation
from src.app.renamed_keys import refuse_renamed_keys
from src.training.disk_cache import DiskClipCache
from src.training.parallel_fill import fill
from src.training.worker_process import prepare_worker_process

REPORT_S = 10.0  # between two lines


def fill_clip_cache(cache: DiskClipCache, workers: int, device: str = "cpu") -> None:
    """Simulate the missing clips; raises OSError where some could not be stored."""
    print(cache.status(), flush=True)
    if device != "cpu":
        missing = cache.missing()
        print(fill(cache.source, missing, cache.store, device=device, workers=workers), flush=True)
        return
    start, before = time.monotonic(), len(cache.missing())
    spawn = multiprocessing.get_context("spawn")
    running = [
        spawn.Process(target=_run_worker, args=(cache,), daemon=True) for _ in range(workers)
    ]
    for process in running:
        process.start()
    while alive := [process for process in running if process.is_alive()]:
        alive[0].join(REPORT_S)
        left = len(cache.missing())
        clip_s = (time.monotonic() - start) / max(before - left, 1)
        print(f"{cache.clips - left} of {cache.clips} clips, {clip_s:.2f} s each", flush=True)
    if missing := cache.missing():
        raise OSError(f"{len(missing)} clips are missing in {cache.folder}")


def _run_worker(cache: DiskClipCache) -> None:
    prepare_worker_process()
    cache.fill()


@hydra.main(version_base=None, config_path="../conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Read the config and fill the caches it names."""
    refuse_renamed_keys(cfg)
    workers = cfg.get("workers", 1)
    if type(workers) is not int or workers < 1:
        raise ValueError(f"workers must be a whole number >= 1, got {workers}")
    device = cfg.get("device", "cpu")
    if device not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {device}")
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device must be cpu where there is no CUDA device, got cuda")
    large = simulation.build_large_crop_stream(cfg)
    if large is not None:
        fill_clip_cache(large.pipeline.cache, workers, device)
    fill_clip_cache(simulation.build_clip_cache(cfg), workers, device)


if __name__ == "__main__":
    entry_point.run_main(main)
