"""From a recording to video: python -m src.reconstruct recording=cap.raw views=views.yaml ckpt=...

Writes the video and `frames.csv`: the time stamp and the events of each frame.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from omegaconf import DictConfig
from rich.progress import track

from src.app import build, entry_point, hardware
from src.deploy.runtime import EventListRuntime
from src.recordings import output, reconstruction
from src.recordings.event_windows import WindowRule, frames_per_window
from src.recordings.files import sources
from src.recordings.files.event_file import ReadOptions
from src.recordings.noise_filter import NoiseFilter
from src.recordings.reconstruction import RunnableNetwork
from src.recordings.views import Views, views_or_whole_sensor
from src.records import results

RULE_KEYS = ("fps", "bins", "splat", "start_s", "end_s")


def reconstruct(cfg: DictConfig) -> Path:
    """Reconstruct `cfg.recording` frame by frame.  Returns the folder of the video.

    Raises ValueError for a recording, views, network or window that do not go together.
    """
    run, count = Path(cfg.paths.run), 0
    hardware.check_device(cfg.device)
    network, views, span = prepare(cfg)
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    with output.open_video_writer(cfg.output_format, run, views.model, cfg.playback_fps) as write:
        for frame in track(frames(cfg, network, views, span), "frames"):
            write(frame)
            count += 1
    print(f"{count} frames in {run}: {output.KINDS[cfg.output_format][1]}, frames.csv")
    return run


def prepare(cfg: DictConfig) -> tuple[RunnableNetwork, Views, int]:
    """Return the network as it is run, the views it takes and how many frames a window spans."""
    network = reconstruction.as_event_network(build.load_network(cfg))
    sensor = sources.sensor_size(cfg.recording, cfg.sensor_size, ReadOptions.from_keys(cfg))
    views = views_or_whole_sensor(cfg.views, sensor, cfg.resolution)
    if not reconstruction.takes_all_views(network, len(views.views)):
        views = views.select([(0, 0)])
    length = cfg.window_length or reconstruction.default_window_length(network)
    span = frames_per_window(length, cfg.fps)
    prepared = reconstruction.build_runnable_network(network, cfg.form, cfg.device, views, cfg.bins)
    return prepared, views, span


def frames(
    cfg: DictConfig, network: RunnableNetwork, views: Views, span: int
) -> Iterator[reconstruction.Frame]:
    """Yield the frames of the recording."""

    options = ReadOptions.from_keys(cfg)

    def read_events() -> Iterator[np.ndarray]:
        events = sources.iter_recording(cfg.recording, views.sensor, options=options)
        if cfg.noise_filter_s is None:
            return events
        return filter(len, map(NoiseFilter(views.sensor, cfg.noise_filter_s), events))

    settings = {key: cfg[key] for key in RULE_KEYS}
    as_lists = isinstance(network, EventListRuntime)
    rule = WindowRule(**settings, frames_per_window=span, as_lists=as_lists)
    given = network, views, rule, cfg.backward_warmup_s
    return reconstruction.reconstruct_recording(read_events, *given, device=cfg.device)


if __name__ == "__main__":
    entry_point.run_command(reconstruct, "reconstruct")
