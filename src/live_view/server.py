"""The web server: the page, its stream of messages, `/status` and `/frame.png`."""

import asyncio
import json
import time
from contextlib import suppress
from pathlib import Path

from aiohttp import WSMsgType, web

from src.live_view import paint
from src.live_view.messages import Page

PAGE = Path(__file__).with_name("live.html")
RATE = 30.0  # pictures a second
LONGEST = 4096  # bytes of a message from the browser
FRESH = {"Cache-Control": "no-store"}
THIS_MACHINE = ("127.0.0.1", "localhost", "::1")


class Server:
    """Serves `page` at `host`:`port` until told to stop."""

    def __init__(self, page: Page, host: str, port: int):
        self.page, self.host, self.port = page, host, port
        self.visitors: set[asyncio.Queue] = set()
        self.app = web.Application(middlewares=[self._own_pages_only], client_max_size=LONGEST)
        self.app.router.add_get("/", self._page)
        self.app.router.add_get("/status", self._status)
        self.app.router.add_get("/frame.png", self._frame)
        self.app.router.add_get("/stream", self._stream)

    async def run(self, ready, stop: asyncio.Event) -> None:
        """Serve until `stop`; `ready` is called once the port is open.

        Raises ValueError where the address cannot be used.
        """
        runner = web.AppRunner(self.app, access_log=None, shutdown_timeout=0.5)
        await runner.setup()
        try:
            await web.TCPSite(runner, self.host, self.port).start()
        except (OSError, OverflowError) as error:
            await runner.cleanup()
            raise ValueError(f"host={self.host} port={self.port} cannot be used: {error}") from None
        try:
            ready()
            await self._tick(stop)
        finally:
            for queue in self.visitors:
                _hand(queue, None)
            await runner.cleanup()

    async def _tick(self, stop: asyncio.Event) -> None:
        """Draw and hand out, RATE times a second."""
        meters, spent = self.page.player.meters, time.thread_time()
        while not stop.is_set():
            started = time.perf_counter()
            self.page.marks.watched = bool(self.visitors)
            if self.visitors and (message := self.page.message()) is not None:
                for queue in self.visitors:
                    _hand(queue, message)
            now = time.thread_time()
            meters.spent("page", now - spent)
            spent = now
            left = 1 / RATE - (time.perf_counter() - started)
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), max(left, 0.001))

    @web.middleware
    async def _own_pages_only(self, request: web.Request, handler) -> web.StreamResponse:
        """Refuse requests that another site's page makes in a visitor's browser."""
        host = request.host.rsplit(":", 1)[0].strip("[]")
        local = self.host in THIS_MACHINE
        origin = request.headers.get("Origin")
        foreign = origin is not None and origin != f"http://{request.host}"
        if foreign or (local and host not in THIS_MACHINE):
            raise web.HTTPForbidden(text="this page serves its own address only")
        return await handler(request)

    async def _page(self, request: web.Request) -> web.Response:
        policy = (
            "default-src 'none'; img-src 'self' blob: data:; style-src 'unsafe-inline'; "
            f"script-src 'unsafe-inline'; connect-src 'self' ws://{request.host}"
        )
        headers = FRESH | {"Content-Security-Policy": policy}
        return web.Response(text=PAGE.read_text(), content_type="text/html", headers=headers)

    async def _status(self, request: web.Request) -> web.Response:
        return web.json_response(self.page.status(), headers=FRESH)

    async def _frame(self, request: web.Request) -> web.Response:
        newest = self.page.screen.newest()
        if newest is None:
            raise web.HTTPServiceUnavailable(text="no frame yet")
        return web.Response(body=paint.png(newest), content_type="image/png", headers=FRESH)

    async def _stream(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(compress=False, max_msg_size=LONGEST, heartbeat=20)
        await socket.prepare(request)
        queue: asyncio.Queue = asyncio.Queue(1)
        queue.put_nowait(self.page.message(whole=True))
        self.visitors.add(queue)
        sending = asyncio.create_task(_send(socket, queue))
        try:
            async for message in socket:
                if message.type == WSMsgType.TEXT:
                    await self._obey(message.data)
        finally:
            self.visitors.discard(queue)
            sending.cancel()
        return socket

    async def _obey(self, text: str) -> None:
        """Do what a visitor asks, in a thread: a network may have to be made ready."""
        try:
            asked = json.loads(text)
            if not isinstance(asked, dict):
                raise ValueError(f"a request must be a mapping, got {asked}")
            await asyncio.to_thread(self.page.obey, asked)
        except ValueError as error:
            self.page.player.faults.tell("request", str(error))


def _hand(queue: asyncio.Queue, message: bytes | None) -> None:
    """Put a message into `queue`, in place of one that a slow visitor has not taken."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(message)


async def _send(socket: web.WebSocketResponse, queue: asyncio.Queue) -> None:
    """Send what is put into `queue`; None closes the socket."""
    with suppress(ConnectionError, RuntimeError):  # the visitor has gone
        while (message := await queue.get()) is not None:
            await socket.send_bytes(message)
        await socket.close()
