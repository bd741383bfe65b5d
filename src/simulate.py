"""Your video through turbulence: python -m src.simulate video=my.mp4 turbulence=strong.

Or a clip of a training, a validation or a test: python -m src.simulate index=3 turbulence=strong.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.progress import track
from torch import Tensor
from yaml import YAMLError

from src import COMMAND
from src.app import console, entry_point, simulation, user_clip_simulation
from src.app.renamed_keys import refuse_renamed_keys
from src.app.user_clip_simulation import SimulatedPart, UserClipSimulation
from src.figures import samples
from src.recordings.files import event_writers
from src.recordings.simulated_recording import kaleidoscope_views, write_recording
from src.recordings.truth_file import create_truth_file
from src.recordings.views import Views
from src.records import results, safe_yaml
from src.sim.optics import Position
from src.sim.pipeline import crop_frames
from src.sim.sensor.response import encode_srgb

SECTIONS = ("scene", "optics", "turbulence", "sensor", "data")
CLIP_KEYS = (*SECTIONS, "seed", "fps", "bins")  # what makes a clip
SCENE_FPS = 120.0  # of a clip of a scene, unless fps says another
DRAWN_FRAMES = 24  # in views.gif


def simulate(cfg: DictConfig) -> dict:
    """Simulate `video` or `photo`, or clip `index` of `split` of a scene; draw clean, views, tilt
    and events of the first DRAWN_FRAMES frames as `views.gif`, of the last of these as `.png`.

    With `like`, the config of another run, it is just the clip that run saw (not augmented), with
    `large` one of its `data.large`.
    A video or photograph, or a clip with `write`, also goes, its views mirrored and misaligned,
    onto one sensor whose events are written to a file, geometry and truth beside it.  Returns what
    was drawn: D/r0, threshold ...
    """
    own = cfg.video or cfg.photo
    if cfg.like and own:
        raise ValueError(f"like must be null with video or photo, got {cfg.like}")
    if cfg.write:  # refused before minutes of work
        height, width = cfg.camera.sensor_size
        event_writers.choose_file_kind(Path(cfg.write), None, width, height, config_key="write")
    if cfg.large and not cfg.like:
        raise ValueError("large must be false without like, got true")
    return simulate_user_clip(cfg) if own else simulate_scene(cfg)


def simulate_user_clip(cfg: DictConfig) -> dict:
    """Simulate all of `video` or `photo` and record it, to `write` or into the run's folder."""
    overrides = entry_point.describe_hydra_command().get("overrides", [])
    user_clip_simulation.refuse_keys_of_scenes(overrides)
    user_clip_simulation.set_user_clip_sensor(cfg, overrides)
    run, clip = Path(cfg.paths.run), user_clip_simulation.read_user_clip(cfg)
    work = UserClipSimulation(cfg, clip)
    if not hasattr(work.sensor, "events"):
        kind = type(work.sensor).__name__
        raise ValueError(f"sensor must be one of events for video and photo, got {kind}")
    camera = place_views(cfg, work.optics.positions, clip.size, work.key)
    drawn = work.drawn_parameters()
    print(work.describe())
    if cfg.photo and not cfg.speed_widths_per_s:
        print("at rest, so that only turbulence makes events; speed_widths_per_s=0.3 moves it")
    path, shown = Path(cfg.write or run / f"{clip.name}.raw"), []
    console.print_replaced_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    views, count = work.allocate_views(path.parent), 0
    with (
        results.store_config_when_done(run, entry_point.resolved_yaml(cfg)),
        create_truth_file(path, camera, len(clip.frames), clip.fps, drawn) as truth,
    ):
        for part in work.simulate_parts(views, track):
            truth.add(part.clean, part.views, part.tilt)
            shown += [part] if count <= DRAWN_FRAMES else []
            count += len(part.clean)
        written = draw_user_clip(run, work, views, shown)
        fps = work.simulated_fps
        events = write_recording(path, views, fps, camera, work.sensor, track, key=work.key)
    print_files(path, events, written)
    return drawn


def draw_user_clip(
    run: Path, work: UserClipSimulation, views: Tensor, parts: list[SimulatedPart]
) -> list[Path]:
    """Draw the first frames as `views.gif` and `views.png`."""
    shown = slice(1, DRAWN_FRAMES + 1)
    clean = torch.cat([part.clean for part in parts])[shown].numpy()
    seen = torch.cat([part.views for part in parts], 1)[:, shown].numpy()
    tilt = torch.cat([part.tilt for part in parts], 1)[:, shown].numpy()
    light = views[None, :, : len(clean) * work.substeps + 1].float()
    counts = work.sensor.voxels(light, work.simulated_fps, 1, substeps=work.substeps)[
        0, :, :, 0
    ].numpy()
    shown_s = 1 / work.clip.fps
    return samples.write_light_field_panels(run, clean, seen, tilt, counts, work.optics, shown_s)


def simulate_scene(cfg: DictConfig) -> dict:
    """Simulate clip `index` of `split` and, with `write`, record it."""
    run, cfg = Path(cfg.paths.run), take_clip_config_from_run(cfg) if cfg.like else cfg
    if cfg.fps is None:
        cfg.fps = SCENE_FPS
    pipeline, step = simulation.build_pipeline(cfg, cfg.split), cfg.data.substeps
    draw = pipeline.draw(cfg.index)
    camera = (
        place_views(cfg, pipeline.optics.positions, draw.crop[2:], draw.key) if cfg.write else None
    )
    views = pipeline.render_views([draw])[0].float()
    sample = pipeline.simulate_sensor([draw], views[None])
    tilt, drawn = pipeline.tilt(draw), sample.parameters[0]
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    counts = sample.voxels[0].sum(2).transpose(0, 1).numpy()
    seen, pushed = (part[:, step::step][:, :DRAWN_FRAMES].numpy() for part in (views, tilt))
    clean = crop_frames(draw.clip.frames, draw.crop)[::step]
    print(describe_clip(cfg, drawn, clean.shape, draw.clip.fps / step))
    how = pipeline.optics, step / draw.clip.fps
    first, counts = clean[1 : DRAWN_FRAMES + 1].numpy(), counts[:, :DRAWN_FRAMES]
    written = samples.write_light_field_panels(run, first, seen, pushed, counts, *how)
    if camera is None:
        print(f"written: {', '.join(map(str, written))}")
        return drawn
    path, fps = Path(cfg.write), draw.clip.fps
    console.print_replaced_path(path)
    sensor: Any = draw.sensor  # one with `events`
    with create_truth_file(path, camera, len(clean), fps / step, drawn) as truth:
        codes = encode_srgb(views) if pipeline.decodes_srgb else views
        truth.add(clean, codes[:, ::step], tilt[:, ::step])
        events = write_recording(path, views, fps, camera, sensor, track, key=draw.key)
    print_files(path, events, written)
    return drawn


def place_views(
    cfg: DictConfig, positions: Sequence[Position], model: tuple[int, int], key: int
) -> Views:
    """Return where the camera of the config has the views, each of `model` (h, w) pixels.

    Raises ValueError where the views do not lie on its sensor.
    """
    sensor, tile_px = tuple(cfg.camera.sensor_size), cfg.camera.tile_px
    try:
        return kaleidoscope_views(
            list(positions), model=model, sensor=sensor, tile_px=tile_px, key=key
        )
    except ValueError as error:
        got = f"{list(sensor)} and {tile_px}"
        wanted = "camera.sensor_size and camera.tile_px must hold all views"
        raise ValueError(f"{wanted}, got {got}: {error}") from error


def describe_clip(cfg: DictConfig, drawn: dict, shape: Sequence[int], fps: float) -> str:
    """Return what a clip of a scene is, in one line."""
    frames, height, width = shape
    return (
        f"clip {cfg.index} of {cfg.split}, {drawn['name']}: {frames} frames of {width}x{height} px "
        f"at {fps:.6g} frames/s; turbulence {drawn['severity']}, contrast threshold "
        f"{drawn['threshold']:.3f}"
    )


def print_files(path: Path, events: np.ndarray, pictures: list[Path]) -> None:
    """Print what was written and how to go on."""
    views, truth = (path.with_suffix(end) for end in (".views.yaml", ".truth.h5"))
    size = truth.stat().st_size / 1e6
    print(f"{len(events)} events in {path}, geometry in {views}")
    print(f"clean frames, views and tilt in {truth} ({size:.1f} MB)")
    print(f"pictures: {', '.join(map(str, pictures))}")
    if len(events):
        given = shlex.join([f"recording={path}", f"views={views}"])
        print(f"next: {COMMAND}reconstruct {given} ckpt=setnet_small")


def take_clip_config_from_run(cfg: DictConfig) -> DictConfig:
    """Return `cfg` with all that makes a clip taken from the run whose config is `cfg.like`.

    Raises ValueError for a file that is no such config, for a former key in it, and for `large`
    where that run has no `data.large`.
    """
    try:
        other = OmegaConf.create(dict(safe_yaml.read(cfg.like)))
        parts = {name: other[name] for name in CLIP_KEYS}
        if not all(isinstance(parts[name], DictConfig) for name in SECTIONS):
            raise TypeError("a section must be a mapping")
    except (OSError, YAMLError, KeyError, TypeError, ValueError, OmegaConfBaseException):
        raise ValueError(f"like must be the config.yaml of a run, got {cfg.like}") from None
    refuse_renamed_keys(OmegaConf.create(parts))
    if cfg.large and not other.data.get("large"):
        raise ValueError(f"large must be false, the run of {cfg.like} has no data.large; got true")
    other = simulation.merge_large_overrides(other) if cfg.large else other
    merged = cfg.copy()
    merged.update({name: other[name] for name in CLIP_KEYS})
    return merged


if __name__ == "__main__":
    entry_point.run_command(simulate, "simulate")
