"""Events in, video out, in a browser, while they come:

    python -m src.live recording=cap.raw views=views.yaml ckpt=setnet_small

`recording` may also be udp://127.0.0.1:7777 or camera://.  Ctrl-C ends it.
"""

import asyncio
import signal
import sys
import warnings
from collections.abc import Mapping, Sequence
from copy import copy

import numpy as np
import torch
from omegaconf import DictConfig

from src.app import entry_point, methods
from src.deploy.runtime import check_thread_count
from src.live_view.event_feeds import Feed, open_feed
from src.live_view.feed_reader import FeedReader, PlaybackClock
from src.live_view.frame_buffer import FrameRing, PolarityAccumulator
from src.live_view.live_windows import WindowCutter, WindowQueue
from src.live_view.network_runner import Controls, RunSettings
from src.live_view.page_server import (
    THIS_MACHINE,
    LivePage,
    PageServer,
    check_address,
    find_page_address,
)
from src.live_view.player import Player
from src.live_view.status import FaultLog, PipelineCounters
from src.models.network import EventToVideoNetwork
from src.recordings.files.event_file import EVENT, ReadOptions
from src.recordings.noise_filter import NoiseFilter
from src.recordings.reconstruction import accepts_views, require_event_network, takes_all_views
from src.recordings.sensor_lookup import SensorLookup, build_lookup
from src.recordings.views import Views, load_views, views_or_whole_sensor
from src.sim.optics import Position

GIL_SWITCH_S = 2e-4  # Python's own 5 ms between two threads is longer than a window


def live(cfg: DictConfig) -> None:
    """Play `cfg.recording` and serve the page until Ctrl-C.

    Raises ValueError for a recording, views, network or address that cannot be used.
    """
    check_thread_count(cfg.threads)
    asyncio.run(check_address(cfg.host, cfg.port))  # before networks are loaded
    torch.set_num_threads(cfg.threads)
    asyncio.run(play_and_serve(build_server(cfg)))


def build_server(cfg: DictConfig) -> PageServer:
    """Return the server of the page, with the network and the number of views chosen."""
    faults, name = FaultLog(), str(cfg.ckpt or "baseline")
    how = {"loop": cfg.loop, "udp_format": cfg.udp_format, "options": ReadOptions.from_keys(cfg)}
    how["in_views"] = None if cfg.views is None else load_views(cfg.views).sensor
    feed = open_feed(cfg.recording, cfg.sensor_size, faults, **how)
    for message in feed.messages:
        warnings.warn(message, stacklevel=2)
    views = views_or_whole_sensor(cfg.views, feed.sensor, cfg.resolution)
    networks = load_offered_networks(cfg, name, views.positions)
    settings = RunSettings(cfg.fps, cfg.bins, cfg.splat, cfg.window_length, cfg.form)
    keys = (
        "playback_speed", "max_waiting_windows", "noise_filter_s", "host", "port",
        "allowed_origins", "tone", "tone_time_constant_s",
    )  # fmt: skip
    server = assemble_server(
        feed, networks, views, settings, faults, **{key: cfg[key] for key in keys}
    )
    server.page.controls.choose(name, cfg.views_used)
    return server


def load_offered_networks(
    cfg: DictConfig, name: str, positions: Sequence[Position]
) -> dict[str, EventToVideoNetwork]:
    """Return the networks to choose from; `name` is the key of the configured one.

    Raises ValueError where that one wants other views than those at `positions`; others that do are
    left out.
    """
    if any(not isinstance(other, str) for other in cfg.offered_networks):
        raise ValueError(f"offered_networks must be a list of words, got {cfg.offered_networks}")
    networks = {}
    for other in dict.fromkeys([*cfg.offered_networks, name]):
        if other == name:
            networks[other] = require_event_network(methods.load_ckpt_or_baseline(cfg))
            continue
        wanted = "offered_networks must be networks"
        networks[other] = methods.load_network_of_kind(EventToVideoNetwork, cfg, other, wanted)
    takes_all_views(networks[name], positions, cfg.views)
    return {other: net for other, net in networks.items() if accepts_views(net, positions)}


def assemble_server(
    feed: Feed,
    networks: Mapping[str, EventToVideoNetwork],
    views: Views,
    settings: RunSettings,
    faults: FaultLog,
    *,
    playback_speed: float = 1.0,
    max_waiting_windows: int = 16,
    noise_filter_s: float | None = None,
    tone: str = "none",
    tone_time_constant_s: float = 0.5,
    host: str = "127.0.0.1",
    port: int = 8600,
    allowed_origins: Sequence[str] = (),
) -> PageServer:
    """Return the server of a page on which `feed` is played through one of `networks`.

    Raises ValueError for a value out of range.
    """
    clock, lookup = PlaybackClock(playback_speed), build_lookup(views)
    counter = PolarityAccumulator(lookup)
    noise_filter = None if noise_filter_s is None else NoiseFilter(views.sensor, noise_filter_s)
    cutter = WindowCutter(
        views.sensor, settings.fps, faults, is_live=feed.is_live, noise_filter=noise_filter
    )
    waiting = WindowQueue(max_waiting_windows, lossless=playback_speed == float("inf"))
    reader = FeedReader(feed, cutter, waiting, counter, clock, PipelineCounters(), faults)
    player = Player(reader, Controls(networks, views, settings), FrameRing(views.model))
    player.set_tone(tone, tone_time_constant_s)
    server = PageServer(LivePage(player, views.positions), host, port, allowed_origins)
    _load_kernels(cutter, lookup)
    return server


def _load_kernels(cutter: WindowCutter, lookup: SensorLookup) -> None:
    """Cut and count a few events, out of order as well, and forget them, so that nothing is loaded
    while the first events wait."""
    counter, trial = PolarityAccumulator(lookup), copy(cutter)
    counter.is_watched, trial.faults = True, FaultLog()
    trial.restart()
    events = np.zeros(100, EVENT)
    events["t"], events["p"] = np.arange(100) * trial.period_us / 10, 1
    for chunk in (events[:50], events[50:][::-1]):
        trial.add(chunk)
        for window in trial.pop_windows(trial.last_us):
            counter.add(window.events)
    cutter.restart()


async def play_and_serve(server: PageServer) -> None:
    """Play and serve until SIGINT (Ctrl-C) or SIGTERM; leaves no thread and no port."""
    stop, player = asyncio.Event(), server.page.player
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)

    def start() -> None:
        player.start()
        is_local, address = server.host in THIS_MACHINE, find_page_address(server.host, server.port)
        seen = "this machine only" if is_local else "other machines can see it too"
        print(f"watch at {address} ({seen}); Ctrl-C ends it", flush=True)

    before = sys.getswitchinterval()
    sys.setswitchinterval(GIL_SWITCH_S)
    try:
        await server.run(start, stop)
    finally:
        player.stop()
        sys.setswitchinterval(before)


if __name__ == "__main__":
    entry_point.run_command(live, "live")
