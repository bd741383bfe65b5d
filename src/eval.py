"""Test a trained network or a baseline: python -m src.eval ckpt=lf3x3 turbulence=strong."""

import time
from pathlib import Path

from omegaconf import DictConfig

from src.app import build, entry_point, evreal_evaluation, hardware, methods, simulation
from src.app.metrics import build_metrics
from src.figures import samples
from src.records import results

SAMPLE_CLIPS = 2  # the first test clips are drawn as GIF and slices


def evaluate(cfg: DictConfig) -> dict:
    """Score the network of `ckpt` or `baseline` on the test clips, write `results.json`.

    Everything goes below `cfg.paths.run`.  Returns the content of `results.json`.
    """
    if cfg.data.get("benchmark") == "evreal":
        return evreal_evaluation.evaluate_on_evreal(cfg)
    run, start = Path(cfg.paths.run), time.perf_counter()
    hardware.reserve_worker_cores(cfg)
    net = methods.load_method_with_postprocess(cfg)
    data = build.build_data_module(cfg, splits=("test",), optics=simulation.select_optics(cfg, net))
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    name, metrics = methods.method_name(cfg), build_metrics(cfg)
    row, drawn = build.test_method(cfg, name, net, data, metrics, SAMPLE_CLIPS)
    samples.write_samples(run / "samples", drawn)
    return results.write_and_print_results(
        run, entry_point.resolved_yaml(cfg), [row], **entry_point.run_metadata(cfg, start)
    )


if __name__ == "__main__":
    entry_point.run_command(evaluate, "eval")
