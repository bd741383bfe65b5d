"""Events in, video out, in a browser, while they come:

    python -m src.live recording=cap.raw views=views.yaml ckpt=setnet_small

`recording` may also be udp://127.0.0.1:7777 or camera://.  Ctrl-C ends it.
"""

import asyncio

import torch
from omegaconf import DictConfig

import src.models
from src.app import build, entry_point
from src.app.instantiate import allowed_packages
from src.live_view.assembly import assemble, play_and_serve
from src.live_view.event_feeds import open_feed
from src.live_view.network_runner import RunSettings
from src.live_view.page_server import PageServer
from src.live_view.status import FaultLog
from src.models.network import EventToVideoNetwork
from src.recordings.files.event_file import ReadOptions
from src.recordings.reconstruction import require_event_network, takes_all_views
from src.recordings.views import load_views, views_or_whole_sensor


def live(cfg: DictConfig) -> None:
    """Play `cfg.recording` and serve the page until Ctrl-C.

    Raises ValueError for a recording, views, network or address that cannot be used.
    """
    if cfg.threads < 1:
        raise ValueError(f"threads must be >= 1, got {cfg.threads}")
    torch.set_num_threads(cfg.threads)
    asyncio.run(play_and_serve(build_server(cfg)))


def build_server(cfg: DictConfig) -> PageServer:
    """Return the server of the page, with the network and the number of views chosen."""
    faults, name = FaultLog(), str(cfg.ckpt or "baseline")
    sensor = cfg.sensor_size or (load_views(cfg.views).sensor if cfg.views else None)
    how = {"loop": cfg.loop, "udp_format": cfg.udp_format, "options": ReadOptions.from_keys(cfg)}
    feed = open_feed(cfg.recording, sensor, faults, **how)
    views = views_or_whole_sensor(cfg.views, feed.sensor, cfg.resolution)
    networks = load_offered_networks(cfg, name, len(views.views))
    settings = RunSettings(cfg.fps, cfg.bins, cfg.splat, cfg.window_length, cfg.form)
    keys = (
        "playback_speed", "max_waiting_windows", "noise_filter_s", "host", "port",
        "allowed_origins", "tone", "tone_time_constant_s",
    )  # fmt: skip
    server = assemble(feed, networks, views, settings, faults, **{key: cfg[key] for key in keys})
    server.page.controls.choose(name, cfg.views_used)
    return server


def load_offered_networks(cfg: DictConfig, name: str, views: int) -> dict[str, EventToVideoNetwork]:
    """Return the networks to choose from; `name` is the key of the configured one.

    Raises ValueError where that one wants another number of `views`; others that do are left out.
    """
    networks: dict[str, EventToVideoNetwork] = {}
    for other in dict.fromkeys([*cfg.offered_networks, name]):
        if other == name:
            networks[name] = require_event_network(build.load_network(cfg))
            takes_all_views(networks[name], views)
        else:
            network = require_event_network(src.models.load(other, allowed_packages(cfg)))
            if network.views in (None, 1, views):
                networks[other] = network
    return networks


if __name__ == "__main__":
    entry_point.run_command(live, "live")
