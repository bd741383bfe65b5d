"""Events in, video out, in a browser, while they come:

    python -m src.live recording=cap.raw views=views.yaml ckpt=setnet_small

`recording` may also be udp://127.0.0.1:7777 or camera://.  Ctrl-C ends it.
"""

import asyncio

import hydra
import torch
from omegaconf import DictConfig
from torch import nn

import src.models
from src.app import build, door
from src.live_view import assembly, feeds
from src.live_view.faults import Faults
from src.live_view.network_step import Running
from src.recordings import stream
from src.recordings.views import Views, load


def live(cfg: DictConfig) -> None:
    """Play `cfg.recording` and serve the page until Ctrl-C.

    Raises ValueError for a recording, views, network or address that cannot be used.
    """
    torch.set_num_threads(cfg.threads)
    server = server_for(cfg)
    asyncio.run(assembly.serve(server))


def server_for(cfg: DictConfig) -> assembly.Server:
    """Return the server of the page, with the network and views that were asked for chosen."""
    faults, name = Faults(), str(cfg.ckpt or "baseline")
    sensor = cfg.sensor_size or (load(cfg.views).sensor if cfg.views else None)
    feed = feeds.open_feed(cfg.recording, sensor, faults, loop=cfg.loop, udp_format=cfg.udp_format)
    if cfg.noise_filter_s is not None:
        feed = feeds.Filtered(feed, cfg.noise_filter_s)
    views = views_for(cfg, feed.sensor)
    how = Running(cfg.fps, cfg.bins, cfg.splat, cfg.unit, cfg.span, cfg.form)
    server = assembly.assemble(
        feed, networks_for(cfg, name, len(views.views)), views, how, faults,
        speed=cfg.speed, backlog=cfg.backlog, host=cfg.host, port=cfg.port,
    )  # fmt: skip
    assembly.first_choice(server.page.controls, name, cfg.use)
    return server


def networks_for(cfg: DictConfig, name: str, views: int) -> dict[str, nn.Module]:
    """Return the networks to choose from, from the smallest; `name`: the one that was asked for.

    Raises ValueError where that one wants another number of `views`.
    """
    chosen = build.chosen(cfg)
    stream.wanted(chosen, views)
    rooms = build.rooms(cfg)
    others = {other: src.models.load(other, rooms) for other in cfg.choices if other != name}
    fit = {other: net for other, net in others.items() if net.views in (None, 1, views)}
    listed = {other: chosen if other == name else fit.get(other) for other in cfg.choices}
    listed.setdefault(name, chosen)
    return {other: net for other, net in listed.items() if net is not None}


def views_for(cfg: DictConfig, sensor: tuple[int, int]) -> Views:
    """Return the views of the recording, at `cfg.resolution` if there is one."""
    size = tuple(cfg.resolution) if cfg.resolution else None
    there = load(cfg.views, sensor) if cfg.views else Views.single(sensor, size or sensor)
    return Views(sensor, size or there.model, there.field, there.views)


@hydra.main(version_base=None, config_path="../conf", config_name="live")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `live`."""
    door.job(live, cfg)


if __name__ == "__main__":
    door.run(main)
