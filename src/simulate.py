"""Look at what the simulation makes: python -m src.simulate turbulence=strong sensor=noisy."""

from pathlib import Path

import hydra
import rich
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from src.app import build, door
from src.figures import samples
from src.recordings import capture
from src.recordings.files import safe_yaml
from src.records import results

SECTIONS = ("scene", "optics", "turbulence", "sensor", "data")
SAME = (*SECTIONS, "seed", "fps", "bins")  # what makes a clip


def simulate(cfg: DictConfig) -> dict:
    """Simulate clip `index` of `split`; write clean, views, tilt and events as `views.gif`, `.png`.

    With `like`, the config of another run, it is just the clip that run saw (not augmented).
    With `write` the views also go, mirrored and misaligned, onto one sensor whose events are
    written to that file, and the truth beside it.

    Returns what was drawn: D/r0, tilt and blur in pixels, threshold ...
    """
    run = Path(cfg.paths.run)
    if cfg.like:
        cfg = alike(cfg)
    pipeline = build.pipeline(cfg, cfg.split)
    draw = pipeline.draw(cfg.index)
    batch = pipeline.views(draw)
    sample, views = pipeline.expose([draw], batch), batch[0]
    tilt = pipeline.tilt(draw)
    windows = slice(cfg.data.substeps, None, cfg.data.substeps)
    results.open_run(run, door.resolved(cfg))
    samples.write_views(run, sample, views[:, windows], tilt[:, windows], pipeline.optics)
    if cfg.write:
        size = tuple(views.shape[-2:])
        camera = capture.kaleidoscope(
            list(pipeline.optics.positions), model=size, key=draw.key,
            sensor=tuple(cfg.camera.sensor), tile_px=cfg.camera.tile_px,
        )  # fmt: skip
        capture.write_recording(cfg.write, views, draw.clip.fps, camera, draw.sensor, tilt=tilt)
    rich.print(sample.drawn[0], f"in {run}")
    return sample.drawn[0]


def alike(cfg: DictConfig) -> DictConfig:
    """Return `cfg` with all that makes a clip taken from the run whose config is `cfg.like`.

    Raises ValueError for a file that is no such config.
    """
    try:
        read = dict(safe_yaml.read(cfg.like))
        # Before there was a seed for them, test clips followed from the training's.
        read["data"] = {"test_seed": read["seed"]} | read["data"]
        other = OmegaConf.create(read)
        parts = {name: other[name] for name in SAME}
        if not all(isinstance(parts[name], DictConfig) for name in SECTIONS):
            raise TypeError("a section must be a mapping")
    except (OSError, YAMLError, KeyError, TypeError, ValueError, OmegaConfBaseException):
        raise ValueError(f"like must be the config.yaml of a run, got {cfg.like}") from None
    merged = cfg.copy()
    for name, part in parts.items():
        merged[name] = part
    return merged


@hydra.main(version_base=None, config_path="../conf", config_name="simulate")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `simulate`."""
    door.job(simulate, cfg)


if __name__ == "__main__":
    door.run(main)
