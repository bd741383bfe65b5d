"""The parts of the live page put together, and the loop that plays and serves it."""

import asyncio
import signal
import sys
from collections.abc import Mapping, Sequence

from src.live_view.event_feeds import Feed
from src.live_view.feed_reader import FeedReader, PlaybackClock
from src.live_view.frame_buffer import FrameRing, PolarityAccumulator
from src.live_view.live_windows import WindowCutter, WindowQueue
from src.live_view.network_runner import Controls, RunSettings
from src.live_view.page_server import THIS_MACHINE, LivePage, PageServer
from src.live_view.player import Player
from src.live_view.status import FaultLog, Meters
from src.models.network import EventToVideoNetwork
from src.recordings.noise_filter import NoiseFilter
from src.recordings.sensor_lookup import build_lookup
from src.recordings.views import Views

GIL_SWITCH_S = 2e-4  # Python's own 5 ms between two threads is longer than a window


def assemble(
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
    clock, counter = PlaybackClock(playback_speed), PolarityAccumulator(build_lookup(views))
    cutter = WindowCutter(views.sensor, settings.fps, faults, is_live=feed.is_live)
    waiting = WindowQueue(max_waiting_windows, lossless=playback_speed == float("inf"))
    noise_filter = None if noise_filter_s is None else NoiseFilter(views.sensor, noise_filter_s)
    reader = FeedReader(feed, cutter, waiting, counter, clock, Meters(), faults, noise_filter)
    player = Player(reader, Controls(networks, views, settings), FrameRing(views.model))
    player.set_tone(tone, tone_time_constant_s)
    return PageServer(LivePage(player, views.positions), host, port, allowed_origins)


async def play_and_serve(server: PageServer) -> None:
    """Play and serve until SIGINT (Ctrl-C) or SIGTERM; leaves no thread and no port."""
    stop, player = asyncio.Event(), server.page.player
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)

    def start() -> None:
        player.start()
        host = f"[{server.host}]" if ":" in server.host else server.host
        is_local = server.host in THIS_MACHINE
        seen = "this machine only" if is_local else "other machines can see it too"
        print(f"watch at http://{host}:{server.port} ({seen}); Ctrl-C ends it", flush=True)

    before = sys.getswitchinterval()
    sys.setswitchinterval(GIL_SWITCH_S)
    try:
        await server.run(start, stop)
    finally:
        player.stop()
        sys.setswitchinterval(before)
