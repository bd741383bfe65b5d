"""A headless Chromium, driven over W3C WebDriver with the standard library."""

import base64
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from urllib.request import Request, urlopen

PROGRAMS = ("chromedriver", "chromium")
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # the key of an element in WebDriver's JSON


def missing() -> list[str]:
    """Return which programs are not there."""
    return [name for name in PROGRAMS if shutil.which(name) is None]


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """Return a port of this machine that nobody listens at."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(seen: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until `seen()`; AssertionError after `seconds`."""
    end = time.monotonic() + seconds
    while not seen():
        assert time.monotonic() < end
        time.sleep(0.02)


class Browser:
    """One page of a browser; `base` is the address of its WebDriver session."""

    def __init__(self, base: str):
        self.base = base

    def call(self, path: str, **body):
        """Send a command and return its value."""
        return _call(f"{self.base}/{path}", body)

    def open(self, address: str) -> None:
        """Open a page."""
        self.call("url", url=address)

    def run(self, script: str, *values):
        """Return what JavaScript returns; `values` are its `arguments`."""
        return self.call("execute/sync", script=script, args=list(values))

    def wait(self, script: str, seconds: float = 60.0):
        """Return what the script returns as soon as that is true."""
        end = time.monotonic() + seconds
        while not (value := self.run(script)):
            if time.monotonic() > end:
                text = self.run("return document.body.innerText")
                raise TimeoutError(f"not in {seconds} s: {script}\n{text}")
            time.sleep(0.05)
        return value

    def text(self, name: str) -> str:
        """Return the text of the element of an id."""
        return self.run("return document.getElementById(arguments[0]).textContent", name)

    def click(self, name: str) -> None:
        """Click the element of an id, as a visitor does."""
        found = self.call("element", using="css selector", value=f"#{name}")[ELEMENT]
        self.call(f"element/{found}/click")

    def drag(self, name: str, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag with the mouse over an element, between two places in shares of its size."""
        left, top, width, height = self.run(
            "const b = document.getElementById(arguments[0]).getBoundingClientRect();"
            "return [b.left, b.top, b.width, b.height]",
            name,
        )
        spots = [(int(left + x * width), int(top + y * height)) for x, y in (start, end)]
        move = [{"type": "pointerMove", "duration": 80, "x": x, "y": y} for x, y in spots]
        press = [{"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}]
        steps = [move[0], press[0], move[1], press[1]]
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}}
        self.call("actions", actions=[mouse | {"actions": steps}])

    def pixels(self, name: str) -> list[int]:
        """Return the red values of a canvas."""
        return self.run(
            "const c = document.getElementById(arguments[0]);"
            "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
            "return Array.from(d.filter((_, k) => k % 4 === 0))",
            name,
        )

    def imitate_phone(self, width: int = 390, height: int = 844) -> None:
        """Show pages as a phone does: at its width, with two pixels for one, for fingers."""
        size = {"width": width, "height": height, "deviceScaleFactor": 2, "mobile": True}
        for name, values in (
            ("DeviceMetricsOverride", size),
            ("TouchEmulationEnabled", {"enabled": True}),
        ):
            self.call("goog/cdp/execute", cmd=f"Emulation.set{name}", params=values)

    def screenshot(self) -> bytes:
        """Return the page as PNG."""
        with urlopen(f"{self.base}/screenshot", timeout=60) as answer:
            return base64.b64decode(json.load(answer)["value"])


@contextmanager
def browser(width: int = 1280, height: int = 900) -> Iterator[Browser]:
    """Start a headless Chromium with a window of a size; it ends with the block."""
    port = free_port()
    driver = subprocess.Popen(
        ["chromedriver", f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    base = f"http://127.0.0.1:{port}"
    try:
        _until_ready(base)
        arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        options = {"args": [*arguments, f"--window-size={width},{height}"]}
        wanted = {"alwaysMatch": {"goog:chromeOptions": options}}
        session = (
            f"{base}/session/{_call(f'{base}/session', {'capabilities': wanted})['sessionId']}"
        )
        try:
            yield Browser(session)
        finally:
            urlopen(Request(session, method="DELETE"), timeout=60).close()
    finally:
        driver.terminate()
        driver.wait(30)


def _call(address: str, body: dict):
    request = Request(address, json.dumps(body).encode(), {"Content-Type": "application/json"})
    with urlopen(request, timeout=120) as answer:
        return json.load(answer)["value"]


def _until_ready(base: str) -> None:
    end = time.monotonic() + 60
    while True:
        try:
            with urlopen(f"{base}/status", timeout=5) as answer:
                if json.load(answer)["value"]["ready"]:
                    return
        except OSError:
            pass
        if time.monotonic() > end:
            raise TimeoutError("chromedriver does not start")
        time.sleep(0.05)
