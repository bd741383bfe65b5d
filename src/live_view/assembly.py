"""The parts put together: a feed, networks and views in, a server that can be run out."""

import asyncio
import signal
import sys
from collections.abc import Mapping

from torch import nn

from src.live_view.backlog import Backlog
from src.live_view.controls import ADAPTIVE, Controls, Steps
from src.live_view.cutter import Cutter
from src.live_view.faults import Faults
from src.live_view.feeds import Feed
from src.live_view.intake import Intake
from src.live_view.meters import Meters
from src.live_view.network_step import Running
from src.live_view.pace import Pace
from src.live_view.player import Player
from src.live_view.reconstruction import Reconstruction
from src.live_view.screen import EventPicture, Screen
from src.live_view.server import THIS_MACHINE, Page, Server
from src.recordings.lookup import build
from src.recordings.views import Views

GIL_S = 2e-4  # Python's own 5 ms between two threads is longer than a window


def assemble(
    feed: Feed,
    networks: Mapping[str, nn.Module],
    views: Views,
    how: Running,
    faults: Faults,
    *,
    speed: float = 1.0,
    backlog: int = 16,
    host: str = "127.0.0.1",
    port: int = 8600,
) -> Server:
    """Return the server of a page on which `feed` is played; `networks` from the smallest.

    Raises ValueError for a value out of range.
    """
    meters, pace, places = Meters(), Pace(speed), views.positions
    cutter = Cutter(views.sensor, how.fps, faults)
    waiting = Backlog(backlog, lossless=speed == float("inf"))
    marks = EventPicture(build(views))
    intake = Intake(feed, cutter, waiting, marks, pace, meters, faults)
    steps = Steps(networks, views, how)
    reconstruction = Reconstruction(waiting, Screen(views.model), meters, steps)
    period_s = 1 / (how.fps * speed)
    controls = Controls(reconstruction, networks, places, period_s=period_s, room=backlog)
    player = Player(intake, reconstruction, meters, faults)
    return Server(Page(player, controls, marks, places), host, port)


def first_choice(controls: Controls, network: str, use: int | str) -> None:
    """Choose `network` on `use` views: a number, `all` or `adaptive`.

    Raises ValueError for another `use`.
    """
    counts = [count for count in controls.offered()[network] if count != ADAPTIVE]
    if use != "all" and use not in controls.offered()[network]:
        allowed = ", ".join(map(str, ["all", *controls.offered()[network]]))
        raise ValueError(f"use must be one of {allowed} for {network}, got {use}")
    controls.choose(network, max(counts) if use == "all" else use)


async def serve(server: Server) -> None:
    """Play and serve until SIGINT (Ctrl-C) or SIGTERM; leaves no thread and no port."""
    stop, player = asyncio.Event(), server.page.player
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    before = sys.getswitchinterval()
    sys.setswitchinterval(GIL_S)
    try:
        await server.run(lambda: _began(server), stop)
    finally:
        player.stop()
        sys.setswitchinterval(before)


def _began(server: Server) -> None:
    """Start playing, and say where to look."""
    server.page.player.start()
    host = f"[{server.host}]" if ":" in server.host else server.host
    seen = "this machine only" if server.host in THIS_MACHINE else "other machines can see it too"
    print(f"watch at http://{host}:{server.port} ({seen}); Ctrl-C ends it", flush=True)
