"""From a recording to video: python -m src.reconstruct recording=cap.raw views=views.yaml ckpt=...

Writes the video and `frames.csv`: the time stamp and the events of each frame.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import hydra
import numpy as np
from omegaconf import DictConfig
from torch import nn

from src.app import build, door
from src.models.runtime import Runtime
from src.recordings import event_lists, lookup, output, progress, stream
from src.recordings.files import sources
from src.recordings.noise_filter import NoiseFilter
from src.recordings.views import Views, load
from src.records import results


def reconstruct(cfg: DictConfig) -> Path:
    """Reconstruct `cfg.recording` frame by frame.  Returns the folder of the video.

    Raises ValueError for a recording, views, network or window that do not go together.
    """
    run, net = Path(cfg.paths.run), build.chosen(cfg)
    views, span = views_for(cfg, net), overlap(cfg, net)
    fast = event_lists.ready(net, cfg.form, cfg.device, views, cfg.bins, cfg.align)
    results.open_run(run, door.resolved(cfg))
    with output.sink(cfg.output, run, views.model, cfg.playback) as write:
        for frame in progress.tell(frames(cfg, fast, views, span), span):
            write(frame)
    return run


def views_for(cfg: DictConfig, net: nn.Module) -> Views:
    """Return the views that `net` takes of the recording: all, or the centre one alone."""
    sensor = sources.sensor_size(cfg.recording, cfg.sensor_size)
    size = tuple(cfg.resolution) if cfg.resolution else None
    there = load(cfg.views, sensor) if cfg.views else Views.single(sensor, size or sensor)
    there = Views(sensor, size or there.model, there.field, there.views)
    return there if stream.wanted(net, len(there.views)) else there.only([(0, 0)])


def overlap(cfg: DictConfig, net: nn.Module) -> int:
    """Return how many frames a window spans; a network that is told its length needs no overlap."""
    if cfg.count:
        return 1
    return stream.overlap(cfg.span or stream.default_span(net), cfg.fps)


def frames(
    cfg: DictConfig, net: nn.Module | Runtime, views: Views, span: int
) -> Iterator[stream.Frame]:
    """Read, cut into windows that span `span` frames, and reconstruct, chunk by chunk."""
    rule = stream.Rule(
        fps=None if cfg.count else cfg.fps,
        count=cfg.count,
        overlap=span,
        bins=cfg.bins,
        splat=cfg.splat,
        unit=cfg.unit,
        start_s=cfg.start,
        end_s=cfg.end,
        grids=not isinstance(net, Runtime),
    )

    def chunks() -> Iterator[np.ndarray]:
        read = sources.events(cfg.recording, views.sensor, cfg.chunk_s)
        if cfg.noise_filter_s is None:
            return read
        kept = map(NoiseFilter(views.sensor, cfg.noise_filter_s), read)
        return (events for events in kept if events.size)

    def run(windows: Iterable[stream.Window]) -> Iterator[stream.Frame]:
        more = {"overlap": span, "carry": carry}
        if isinstance(net, Runtime):
            return event_lists.frames(windows, net, **more)
        return stream.frames(windows, net, positions=views.positions, device=cfg.device, **more)

    table, carry = lookup.build(views), stream.Carry()
    if cfg.look_ahead_s:
        for _ in run(stream.backwards(chunks(), table, rule, cfg.look_ahead_s)):
            pass
        carry.turn()
    return run(stream.windows(chunks(), table, rule))


@hydra.main(version_base=None, config_path="../conf", config_name="reconstruct")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `reconstruct`."""
    door.job(reconstruct, cfg)


if __name__ == "__main__":
    door.run(main)
