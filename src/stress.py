"""Stress tests of networks: python -m src.stress [ckpt=[lf3x3,single256]]."""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from inspect import signature
from multiprocessing import get_context
from pathlib import Path
from typing import cast

import rich
import torch
from omegaconf import DictConfig, OmegaConf

from src import HOME
from src.app import compared_networks, entry_point, simulation
from src.app.instantiate import FUNCTIONS, as_dict, build_part
from src.bench.candidates import Candidate
from src.bench.stress_tests import arguments, stress_results
from src.bench.stress_tests.event_clips import StressBench
from src.figures.stress_map import draw_stress_map
from src.records import results
from src.records.atomic import write_text
from src.training.worker_process import exit_with_parent

NetworkResults = tuple[dict[str, stress_results.Outcome], float | None]


def stress(cfg: DictConfig) -> stress_results.Outcomes:
    """Run every stress test on every network; write the map, `stress.csv` and `stress.md`.

    Returns the outcomes, test by test and network by network.  Raises ValueError for networks,
    tests, or numbers of processes, clips or windows that are none.
    """
    if cfg.processes < 1:
        raise ValueError(f"processes must be >= 1, got {cfg.processes}")
    if cfg.clips < 1:
        raise ValueError(f"clips must be >= 1, got {cfg.clips}")
    simulation.check_unscored_windows(cfg)
    run, config = Path(cfg.paths.run), entry_point.resolved_yaml(cfg)
    candidates, titles, _ = _load(config)
    results.create_run_folder(run, config)
    outcomes: stress_results.Outcomes = {name: {} for name in titles}
    standard_psnr = {}
    found = _run_tests(cfg, config, len(candidates))
    for candidate, (own, psnr) in zip(candidates, found, strict=True):
        for test, outcome in own.items():
            outcomes[test][candidate.name] = outcome
        if psnr is not None:
            standard_psnr[candidate.name] = psnr
        write_text(run / "stress.csv", stress_results.format_outcomes_csv(outcomes, titles))
        print(f"{candidate.name} is done", flush=True)
    text = stress_results.format_summary_per_network(outcomes, titles, standard_psnr)
    write_text(run / "stress.md", text)
    for suffix in ("png", "svg"):
        draw_stress_map(run / f"stress.{suffix}", outcomes, titles, standard_psnr)
    rich.print(text)
    print(f"in {run}")
    return outcomes


def _run_tests(cfg: DictConfig, config: str, networks: int) -> Iterator[NetworkResults]:
    """Yield the results of each network, in their order; several at once in `processes`, each of
    which loads the networks itself: spectral norms cannot be pickled.
    """
    run = partial(_test_network, config)
    if cfg.processes == 1:
        yield from map(run, range(networks))
        return
    context = get_context("spawn")  # a fork would inherit threads that are no longer there
    with ProcessPoolExecutor(cfg.processes, context, _prepare_process) as pool:
        yield from pool.map(run, range(networks))


def _prepare_process() -> None:
    torch.set_num_threads(1)
    exit_with_parent()


def _test_network(config: str, index: int) -> NetworkResults:
    candidates, _, run_tests = _load(config)
    return run_tests(candidates[index])


@cache
def _load(
    config: str,
) -> tuple[list[Candidate], dict[str, str], Callable[[Candidate], NetworkResults]]:
    """Return the networks, the tests' titles and what runs the tests on one; ValueError for tests
    that are none, and for their arguments."""
    cfg = cast(DictConfig, OmegaConf.create(config))
    keys = {name: f"stress_tests.{name}.test" for name in cfg.stress_tests}
    tests = {name: build_part(cfg, key, _partial_=True) for name, key in keys.items()}
    pipeline = simulation.build_pipeline(cfg, "test")
    for name, key in keys.items():
        _check_arguments(key, tests[name], cfg.fps)
    titles = {name: _fill_title(cfg, name, test) for name, test in tests.items()}
    bench = StressBench(pipeline, range(cfg.clips), cfg.data.unscored_windows)
    tester = partial(stress_results.run_stress_tests, tests=tests, bench=bench)
    return compared_networks.load_candidates(cfg), titles, tester


def _check_arguments(key: str, test: Callable[..., object], fps: float) -> None:
    assert isinstance(test, partial)
    if not test.func.__module__.removeprefix(HOME).startswith(FUNCTIONS):
        return  # the user's own
    try:
        signature(test.func).bind("network", "bench", **test.keywords)
    except TypeError as error:
        raise ValueError(f"{key} must have the test's own arguments: {error}") from None
    arguments.check_arguments(key, test.func.__name__, test.keywords, fps)


def _fill_title(cfg: DictConfig, name: str, test: partial[object]) -> str:
    typed = {k: as_dict(v) if OmegaConf.is_config(v) else v for k, v in test.keywords.items()}
    title = str(cfg.stress_tests[name].title)
    return arguments.fill_title(f"stress_tests.{name}.title", title, typed)


if __name__ == "__main__":
    entry_point.run_command(stress, "stress")
