"""Look at what the simulation makes: python -m src.simulate turbulence=strong sensor=noisy."""

from pathlib import Path
from typing import Any

import rich
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from src.app import build, entry_point
from src.figures import samples
from src.recordings import simulated_recording
from src.recordings.files import event_writers
from src.records import results, safe_yaml

SECTIONS = ("scene", "optics", "turbulence", "sensor", "data")
CLIP_KEYS = (*SECTIONS, "seed", "fps", "bins")  # what makes a clip


def simulate(cfg: DictConfig) -> dict:
    """Simulate clip `index` of `split`; write clean, views, tilt and events as `views.gif`, `.png`.

    With `like`, the config of another run, it is just the clip that run saw (not augmented).
    With `write` the views also go, mirrored and misaligned, onto one sensor whose events are
    written to that file, and the truth beside it.  Returns what was drawn: D/r0, threshold ...
    """
    run = Path(cfg.paths.run)
    if cfg.index < 0:
        raise ValueError(f"index must be >= 0, the number of a clip, got {cfg.index}")
    if cfg.write:  # refused before minutes of work
        height, width = cfg.camera.sensor
        event_writers.find_kind(Path(cfg.write), None, width, height, "evt3")
    cfg = take_clip_config_from_run(cfg) if cfg.like else cfg
    pipeline = build.build_pipeline(cfg, cfg.split)
    draw = pipeline.draw(cfg.index)
    views = pipeline.render_views([draw])[0].float()
    sample = pipeline.simulate_sensor([draw], views[None])
    tilt = pipeline.tilt(draw)
    windows = slice(cfg.data.substeps, None, cfg.data.substeps)
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    seen = views[:, windows], tilt[:, windows], pipeline.optics
    written = samples.write_light_field(run, sample, *seen)
    if cfg.write:
        height, width = views.shape[-2:]
        sensor: Any = draw.sensor  # one with `events`
        camera = simulated_recording.kaleidoscope_views(
            list(pipeline.positions), model=(height, width), key=draw.key,
            sensor=tuple(cfg.camera.sensor), tile_px=cfg.camera.tile_px,
        )  # fmt: skip
        simulated_recording.write_recording(
            cfg.write, views, draw.clip.fps, camera, sensor, tilt=tilt
        )
        written += [Path(cfg.write)]
        written += [Path(cfg.write).with_suffix(end) for end in (".views.yaml", ".truth.h5")]
    rich.print(sample.parameters[0])
    print(f"clip {cfg.index} of {cfg.split}: {', '.join(map(str, written))}")
    return sample.parameters[0]


def take_clip_config_from_run(cfg: DictConfig) -> DictConfig:
    """Return `cfg` with all that makes a clip taken from the run whose config is `cfg.like`.

    Raises ValueError for a file that is no such config.
    """
    try:
        other = OmegaConf.create(dict(safe_yaml.read(cfg.like)))
        parts = {name: other[name] for name in CLIP_KEYS}
        if not all(isinstance(parts[name], DictConfig) for name in SECTIONS):
            raise TypeError("a section must be a mapping")
    except (OSError, YAMLError, KeyError, TypeError, ValueError, OmegaConfBaseException):
        raise ValueError(f"like must be the config.yaml of a run, got {cfg.like}") from None
    merged = cfg.copy()
    merged.update(parts)
    return merged


if __name__ == "__main__":
    entry_point.run_command(simulate, "simulate")
