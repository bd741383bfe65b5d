"""The web server: the page, its stream of messages, `/status` and `/frame.png`.

A message of the stream is the length of a JSON header (uint32, little endian), the header, and the
JPEGs it lists.  The browser answers each by the text `received`: no more than MOST_ON_THEIR_WAY are
sent without that answer.  It asks in JSON: pause, line, network and views, all_views, tone,
one_view; what makes no sense is answered by a header with `refused`, a line.
"""

import asyncio
import ipaddress
import json
import math
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
from aiohttp import WSMsgType, web

from src.live_view.frame_buffer import (
    Line,
    TimeSlice,
    draw_events,
    encode_jpeg,
    tile_views_without_gaps,
)
from src.live_view.player import Player
from src.recordings.tone import ToneCurve
from src.sim.optics import Position

HTML = Path(__file__).with_name("live.html")
PICTURES_HZ = 30.0
STATUS_S = 0.25  # between two readings of the meters on the page
RECEIVED = "received"
MOST_ON_THEIR_WAY = 2  # messages to a visitor; 30 a second also where an answer takes 60 ms
MAX_REQUEST_BYTES = 4096
SHOWN_REQUEST = 40  # characters of a request that is refused
NO_CACHE = {"Cache-Control": "no-store"}
ORIGIN = re.compile(r"(https?://[a-z0-9.-]+(:\d+)?)/?")
THIS_MACHINE = ("127.0.0.1", "localhost", "::1")
FLAGS = ("pause", "all_views", "one_view")
SLOW_REQUESTS = ("network", "one_view")  # may have to make a network ready
REQUESTS = (*FLAGS, "tone", "line", "network", "views")
ALL_ADDRESSES = ("0.0.0.0", "::")


class LivePage:
    """The messages that all visitors get, and what they ask for."""

    def __init__(self, player: Player, positions: list[Position]):
        self.player, self.positions = player, positions
        self.controls, self.counter = player.controls, player.reader.counter
        self.frames = player.frames
        self.slice = TimeSlice(self.frames)
        self.all_views = False
        self.frames_sent = -1  # count of frames at the last picture
        self.status_sent = 0.0  # wall time

    def message(self, *, whole: bool = False) -> bytes | None:
        """Return what is new since the last call, None where nothing is; or everything, for one
        visitor: what is new remains so for the others.

        Where one picture cannot be drawn, it and those after it are left out: a fault.
        """
        pictures = {}
        try:
            for name, picture in self._draw_pictures(whole):
                pictures[name] = picture
        except Exception as error:  # one picture must not end the page
            fault = f"pictures cannot be drawn: {type(error).__name__}: {error}"
            self.player.faults.report("pictures", fault)
        header, now = {}, time.perf_counter()
        if whole or now - self.status_sent >= STATUS_S:
            header["status"] = self.status()
            self.status_sent = self.status_sent if whole else now
        elif not pictures:
            return None
        return _pack(header, pictures)

    def status(self) -> dict:
        """Return the meters, and what is chosen and offered."""
        status, slice_s = self.player.status(), self.frames.measure_length_s()
        return status | {
            "line": self.slice.line,
            "slice_s": None if slice_s is None else round(slice_s, 2),
            "all_views": self.all_views,
            "one_view": self.controls.one_view_runner is not None,
            "offered": self.controls.offered,
            "chosen": self.controls.chosen,
            "preparing": self.controls.preparing,
        }

    def _draw_pictures(self, whole: bool) -> Iterator[tuple[str, bytes]]:
        """Yield the name and the JPEG of each picture that is new, or of all."""
        count, newest = self.frames.count, self.frames.newest()
        if newest is None:
            return
        if whole or count != self.frames_sent:
            self.frames_sent = self.frames_sent if whole else count
            yield "frame", encode_jpeg(newest)
            if (one_view := self.player.one_view) is not None:
                yield "one-view", encode_jpeg(cv2.convertScaleAbs(one_view, alpha=255))
        if whole or self.counter.windows:
            counts = self.counter.taken if whole else self.counter.take()
            centre = self.positions.index((0, 0)) if (0, 0) in self.positions else 0
            yield "events", encode_jpeg(draw_events(counts[centre]))
            if self.all_views:
                yield "views", encode_jpeg(tile_views_without_gaps(counts, self.positions))
        if (drawn := self.slice.draw(always=whole)) is not None:
            yield "slice", encode_jpeg(drawn)

    def handle_request(self, request: dict) -> None:
        """Do what a visitor asks; raises ValueError, and does nothing, where a part of it makes no
        sense."""
        self._check_request(request)
        if "pause" in request:
            self.player.set_paused(request["pause"])
        if "tone" in request:
            self.player.set_tone(request["tone"])
        if "all_views" in request:
            self.all_views = request["all_views"]
        if "line" in request:
            self.slice.line = _parse_line(request["line"])
        if "network" in request:
            self.controls.choose(str(request["network"]), request.get("views", "all"))
        if "one_view" in request:
            self.controls.compare_one_view(request["one_view"])

    def _check_request(self, request: dict) -> None:
        if unknown := request.keys() - set(REQUESTS):
            raise ValueError(f"a request must be of {', '.join(REQUESTS)}, got {min(unknown)}")
        for name in FLAGS:
            if not isinstance(request.get(name, False), bool):
                raise ValueError(f"{name} must be true or false, got {request[name]}")
        if "tone" in request:
            ToneCurve(str(request["tone"]))
        if "line" in request:
            _parse_line(request["line"])
        if "network" in request:
            self.controls.count_views(str(request["network"]), request.get("views", "all"))
        elif "views" in request:
            raise ValueError(f"views must come with network, got views={request['views']} alone")


def _pack(header: dict, pictures: dict[str, bytes]) -> bytes:
    sizes = [[name, len(data)] for name, data in pictures.items()]
    text = json.dumps(header | {"pictures": sizes}).encode()
    return len(text).to_bytes(4, "little") + text + b"".join(pictures.values())


def _unpack(message: bytes) -> tuple[dict, dict[str, bytes]]:
    at = 4 + int.from_bytes(message[:4], "little")
    header, pictures = json.loads(message[4:at]), {}
    for name, size in header["pictures"]:
        pictures[name] = message[at : at + size]
        at += size
    return header, pictures


def _merge(older: bytes, newer: bytes) -> bytes:
    """Return a message of all that is in one of two, of what is in both the newer."""
    (header, pictures), (new_header, new_pictures) = map(_unpack, (older, newer))
    return _pack(header | new_header, pictures | new_pictures)


def _parse_request(text: str) -> dict:
    """Return what a visitor asks; raises ValueError where it is no JSON object."""
    with suppress(ValueError, RecursionError):
        if isinstance(request := json.loads(text), dict):
            return request
    got = text if len(text) <= SHOWN_REQUEST else text[:SHOWN_REQUEST] + "..."
    raise ValueError(f'a request must be a JSON object such as {{"pause": true}}, got {got}')


def _parse_line(numbers: object) -> Line:
    if (
        not isinstance(numbers, list)
        or len(numbers) != 4
        or not all(isinstance(n, int | float) and math.isfinite(n) for n in numbers)
    ):
        raise ValueError(f"line must be x0, y0, x1, y1 in pixels, got {numbers}")
    x0, y0, x1, y1 = (min(max(float(n), -1e4), 1e4) for n in numbers)
    return x0, y0, x1, y1


class PageServer:
    """Serves `page` at `host`:`port` until told to stop.

    `allowed_origins`: addresses of a proxy before it, such as https://cam.example.org, whose page
    may use the stream.  Raises ValueError for one that is no address of a site.
    """

    def __init__(self, page: LivePage, host: str, port: int, allowed_origins: Sequence[str] = ()):
        self.page, self.host, self.port = page, host, port
        self.origins = {_parse_origin(origin) for origin in allowed_origins}
        self.proxies = {origin.partition("://")[2] for origin in self.origins}
        self.visitors: set[asyncio.Queue] = set()
        self.answers: set[asyncio.Task] = set()  # being made
        self.one_by_one = asyncio.Lock()  # SLOW_REQUESTS are done
        self.app = web.Application(
            middlewares=[self._own_pages_only], client_max_size=MAX_REQUEST_BYTES
        )
        self.app.router.add_get("/", self._page)
        self.app.router.add_get("/status", self._status)
        self.app.router.add_get("/frame.png", self._frame)
        self.app.router.add_get("/stream", self._stream)

    async def run(self, on_ready: Callable[[], None], stop: asyncio.Event) -> None:
        """Serve until `stop`; `on_ready` is called once the port is open, of 0 one that is free.

        Raises ValueError where the address cannot be used.
        """
        runner = web.AppRunner(self.app, access_log=None, shutdown_timeout=0.5)
        await runner.setup()
        try:
            with _named_address(self.host, self.port):
                await web.TCPSite(runner, self.host, self.port).start()
            self.port = runner.addresses[0][1]
            on_ready()
            await self._tick(stop)
        finally:
            for queue in self.visitors:
                if queue.full():
                    queue.get_nowait()
                queue.put_nowait(None)  # the end
            await runner.cleanup()

    async def _tick(self, stop: asyncio.Event) -> None:
        """Draw and hand out, PICTURES_HZ times a second."""
        meters, before = self.page.player.meters, time.thread_time()
        while not stop.is_set():
            started = time.perf_counter()
            self.page.counter.is_watched = bool(self.visitors)
            if self.visitors and (message := self.page.message()) is not None:
                self._hand_out(message)
            now = time.thread_time()
            meters.add_busy_time("page", now - before)
            before = now
            left = 1 / PICTURES_HZ - (time.perf_counter() - started)
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), max(left, 0.001))

    def _hand_out(self, message: bytes) -> None:
        """Put `message` into every queue; in place of one that a slow visitor has not taken, put
        the newer of each part of both."""
        for queue in self.visitors:
            untaken = queue.get_nowait() if queue.full() else None
            queue.put_nowait(message if untaken is None else _merge(untaken, message))

    @web.middleware
    async def _own_pages_only(self, request: web.Request, handler) -> web.StreamResponse:
        """Refuse requests that another site's page makes in a visitor's browser: from its origin,
        or by its name, which it may have bound to this machine's address."""
        host = request.host.rsplit(":", 1)[0].strip("[]")
        origin = request.headers.get("Origin")
        known = origin in (None, f"http://{request.host}") or origin in self.origins
        if not known or not (request.host in self.proxies or self._is_own_name(host)):
            how = "other names: allowed_origins=[http://<name>:<port>]"
            raise web.HTTPForbidden(text=f"this page serves its own address only; {how}")
        return await handler(request)

    def _is_own_name(self, host: str) -> bool:
        """Return whether `host` is an address or the name of this machine."""
        if host in THIS_MACHINE or self.host in THIS_MACHINE:
            return host in THIS_MACHINE
        name = socket.gethostname().lower()
        return _is_ip_address(host) or host.lower() in (self.host.lower(), name, f"{name}.local")

    async def _page(self, request: web.Request) -> web.Response:
        streams = " ".join(f"ws://{host} wss://{host}" for host in sorted(self.proxies))
        policy = (
            "default-src 'none'; img-src 'self' blob: data:; style-src 'unsafe-inline'; "
            f"script-src 'unsafe-inline'; connect-src 'self' ws://{request.host} {streams}"
        )
        headers = NO_CACHE | {"Content-Security-Policy": policy}
        return web.Response(text=HTML.read_text(), content_type="text/html", headers=headers)

    async def _status(self, request: web.Request) -> web.Response:
        return web.json_response(self.page.status(), headers=NO_CACHE)

    async def _frame(self, request: web.Request) -> web.Response:
        newest = self.page.frames.newest()
        if newest is None:
            raise web.HTTPServiceUnavailable(text="no frame yet")
        content = cv2.imencode(".png", newest)[1].tobytes()
        return web.Response(body=content, content_type="image/png", headers=NO_CACHE)

    async def _stream(self, request: web.Request) -> web.WebSocketResponse:
        visitor = web.WebSocketResponse(
            compress=False, max_msg_size=MAX_REQUEST_BYTES, heartbeat=20
        )
        await visitor.prepare(request)
        queue: asyncio.Queue = asyncio.Queue(1)
        room = asyncio.BoundedSemaphore(MOST_ON_THEIR_WAY)
        queue.put_nowait(self.page.message(whole=True))
        self.visitors.add(queue)
        sending = asyncio.create_task(_send(visitor, queue, room))
        try:
            async for message in visitor:
                if message.type != WSMsgType.TEXT:
                    continue
                if message.data == RECEIVED:
                    with suppress(ValueError):  # answers more than were sent
                        room.release()
                    continue
                answer = asyncio.create_task(self._answer(visitor, message.data))
                self.answers.add(answer)
                answer.add_done_callback(self.answers.discard)
        finally:
            self.visitors.discard(queue)
            sending.cancel()
        return visitor

    async def _answer(self, visitor: web.WebSocketResponse, text: str) -> None:
        """Do what a visitor asks, SLOW_REQUESTS in a thread, so that others do not wait; or send
        why it is refused."""
        try:
            request = _parse_request(text)
            if request.keys() & set(SLOW_REQUESTS):
                async with self.one_by_one:
                    await asyncio.to_thread(self.page.handle_request, request)
            else:
                self.page.handle_request(request)
        except (ValueError, OverflowError) as error:
            with suppress(ConnectionError, RuntimeError):  # the visitor has gone
                await visitor.send_bytes(_pack({"refused": str(error)}, {}))


async def check_address(host: str, port: int) -> None:
    """Raise ValueError where a page cannot be served at `host`:`port`."""
    with _named_address(host, port):
        server = await asyncio.get_running_loop().create_server(asyncio.Protocol, host, port)
    server.close()
    await server.wait_closed()


@contextmanager
def _named_address(host: str, port: int) -> Iterator[None]:
    """Raise ValueError in place of the errors of an address that cannot be used."""
    try:
        yield
    except (OSError, OverflowError) as error:
        raise ValueError(f"host={host} port={port} cannot be used: {error}") from None


def find_page_address(host: str, port: int) -> str:
    """Return where a page that listens at `host` is found: of all addresses, this machine's in its
    network, else its name."""
    if host in ALL_ADDRESSES:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(("192.0.2.1", 9))  # sends nothing: it chooses the way out
                host = probe.getsockname()[0]
            except OSError:
                host = socket.gethostname()
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _is_ip_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _parse_origin(origin: str) -> str:
    found = ORIGIN.fullmatch(str(origin).lower())
    if found is None:
        wanted = "addresses such as https://cam.example.org"
        raise ValueError(f"allowed_origins must be {wanted}, got {origin}")
    return found[1]


async def _send(
    visitor: web.WebSocketResponse, queue: asyncio.Queue, room: asyncio.BoundedSemaphore
) -> None:
    """Send what is put into `queue`, each when there is `room` for one more on its way: what waits
    before a socket grows old.  None closes the stream."""
    with suppress(ConnectionError, RuntimeError):  # the visitor has gone
        while await room.acquire() and (message := await queue.get()) is not None:
            await visitor.send_bytes(message)
        await visitor.close()
