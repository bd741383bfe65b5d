"""Run folders made by hand: what the entry points write, with numbers chosen by the test."""

import json
from pathlib import Path

import yaml
from PIL import Image

from src.records import results

SCORES = {"lpips": 0.4, "ssim": 0.6, "psnr": 17.0, "psnr_aligned": 20.0, "temporal_jitter_px": 1.0}
UNTRAINED = {"untrained": {"clips": 9, "ssim": {"mean": 0.1, "std": 0.0}}}


def write_run(
    folder: Path,
    experiment: str = "lf3x3",
    seed: int = 0,
    *,
    choices: dict | None = None,
    overrides: tuple[str, ...] = (),
    settings: dict | None = None,
    scores: dict | None = None,
    clips: list[dict] | None = None,
    task: str = "train",
    config_name: str = "table1",
    compared: dict | None = None,
    without: tuple[str, ...] = (),
    git: str = "abc",
    own: dict[str, int] | None = None,
) -> Path:
    """Write `config.yaml`, `results.json`, `clips.csv` of one run; return its folder.

    `without`: metrics that were not taken; `own`: those that a config has added.
    """
    folder.mkdir(parents=True)
    config = {"task": task, "name": experiment, "seed": seed, "ckpt": None, "lr": 1e-3}
    config |= {"paths": {"run": str(folder)}, "logger": {"dir": f"{folder}/logs"}}
    text = yaml.safe_dump(config | (settings or {}))
    (folder / "config.yaml").write_text(text)
    asked = [f"experiment={experiment}", f"seed={seed}", *overrides]
    found = {"mean": 0.0, "std": 0.1}
    means = SCORES | (scores or {})
    if clips:
        summary = results.summarize_scores(clips)
        means = {key: score["mean"] for key, score in summary.items() if key != "clips"}
    means = {key: value for key, value in means.items() if key not in without}
    record = {
        "schema": 1,
        "task": task,
        "experiment": experiment,
        "seed": seed,
        "asked": {
            "config": config_name,
            "choices": {"experiment": experiment} | (choices or {}),
            "overrides": asked,
        },
        "wall_s": 1.0,
        "device": "cpu, 1 threads",
        "git": git,
        "config_sha256": results.hash_config(text),
        "model": {"name": experiment, "params": 1234567, "macs_per_frame": 608_000_000},
        "test": {"clips": len(clips or range(9))}
        | {key: found | {"mean": value} for key, value in means.items()},
        "latency_ms": {"128x128": 13.8},
        "compared": UNTRAINED if compared is None else compared,
        "own_metrics": own or {},
    }
    (folder / "results.json").write_text(json.dumps(record))
    if clips:
        (folder / "clips.csv").write_text(
            results.format_csv(clips[0], [clip.values() for clip in clips])
        )
    return folder


def clips_of(severities: str = "weak medium strong", lpips: float = 0.3) -> list[dict]:
    """Return a clip per severity; LPIPS grows by 0.1 from each to the next."""
    return [
        SCORES | {"name": f"clip{k}", "severity": name, "lpips": lpips + 0.1 * k}
        for k, name in enumerate(severities.split())
    ]


def write_sweep(folder: Path, params: dict, overrides: tuple[str, ...] = ()) -> None:
    """Write the `multirun.yaml` that Hydra leaves in a sweep's folder."""
    hydra = {
        "sweeper": {"params": params},
        "overrides": {"task": list(overrides)},
        "job": {"name": "train", "config_name": "table1"},
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "multirun.yaml").write_text(yaml.safe_dump({"hydra": hydra}))


def write_samples(folder: Path, size: int = 8) -> None:
    """Write the pictures of one clip, as a run leaves them."""
    samples = folder / "samples"
    samples.mkdir()
    Image.new("L", (size, size)).save(samples / "clip0.gif")
    Image.new("L", (size, size)).save(samples / "clip0_slice.png")
