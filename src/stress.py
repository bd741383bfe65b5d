"""Where methods fail: python -m src.stress, or python -m src.stress ckpt=[lf3x3,setnet_small]."""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import hydra
import rich
import torch
from omegaconf import DictConfig, OmegaConf

from src.app import build, door, lineup
from src.bench.candidates import Candidate
from src.bench.probes import suite
from src.bench.probes.standard import Bench
from src.figures.heatmap import stress_map
from src.records import results


def stress(cfg: DictConfig) -> suite.Found:
    """Put every network through every probe; write the map, `stress.csv` and `stress.md`.

    Returns the findings, probe by probe and network by network.  Raises ValueError for networks,
    probes or a number of processes that are no such thing.
    """
    if cfg.processes < 1:
        raise ValueError(f"processes must be >= 1, got {cfg.processes}")
    run = Path(cfg.paths.run)
    candidates, examine = lineup.gather(cfg), _examiner(cfg)
    titles = {name: str(node.title) for name, node in cfg.probes.items()}
    results.open_run(run, door.resolved(cfg))

    def keep(findings: suite.Found) -> None:
        results.write_text(run / "stress.csv", suite.table(findings, titles))

    findings, standards = suite.gather(_accounts(cfg, candidates, examine), keep)
    text = suite.words(findings, titles, standards)
    results.write_text(run / "stress.md", text)
    for suffix in ("png", "svg"):
        stress_map(run / f"stress.{suffix}", findings, titles, standards)
    rich.print(text, f"in {run}")
    return findings


def _accounts(
    cfg: DictConfig, candidates: list[Candidate], examine: Callable[[Candidate], suite.Account]
) -> Iterator[suite.Account]:
    """Yield what is found of each network, in their order; several at once in `processes`, each of
    which loads the networks itself: spectral norms do not travel.
    """
    if cfg.processes == 1:
        build.share_cores(cfg)
        yield from map(examine, candidates)
        return
    plain = OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))
    context = get_context("spawn")  # a fork would inherit threads that are no longer there
    with ProcessPoolExecutor(cfg.processes, context, _begin, (plain,)) as pool:
        yield from pool.map(_examine, range(len(candidates)))


def _examiner(cfg: DictConfig) -> Callable[[Candidate], suite.Account]:
    """Return what puts a network through the probes; ValueError for probes that are none."""
    probes = {name: build.part(cfg, f"probes.{name}.probe") for name in cfg.probes}
    bench = Bench(build.pipeline(cfg, "test"), range(cfg.clips), cfg.data.warmup)
    return partial(suite.examine, probes=probes, bench=bench)


def _begin(cfg: DictConfig) -> None:
    """Start a process: one thread; networks, clips and probes of its own."""
    global _here
    torch.set_num_threads(1)
    _here = lineup.gather(cfg), _examiner(cfg)


def _examine(index: int) -> suite.Account:
    candidates, examine = _here
    return examine(candidates[index])


@hydra.main(version_base=None, config_path="../conf", config_name="stress")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `stress`."""
    door.job(stress, cfg)


if __name__ == "__main__":
    door.run(main)
