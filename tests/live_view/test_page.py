"""The real page in a real browser, fed over UDP: what a visitor sees and does."""

import json
import os
import signal
import socket
import time
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest

from tests.faults.harness import Run, run_program
from tests.live_view import browser, scenes
from tests.live_view.browser import until

STATE = "return document.getElementById('state').dataset.state === '{}'"
FAULT = "return document.getElementById('faults').textContent.includes('{}')"
FRAMES = "return document.getElementById('fps').textContent > 0"


class Server:
    """`python -m src.live` on a UDP port, in a process of its own."""

    def __init__(self, folder: Path):
        self.events, self.port = browser.free_port(socket.SOCK_DGRAM), browser.free_port()
        scenes.views().save(folder / "views.yaml")
        overrides = [
            f"recording=udp://127.0.0.1:{self.events}",
            f"views={folder}/views.yaml",
            f"port={self.port}",
            f"hydra.run.dir={folder}/run",
            "ckpt=setnet_small",
            "offered_networks=[setnet_small,setnet_medium]",
            "fps=30",
            "threads=1",
        ]
        self.run = Run(folder / "log", run_program, "live", *overrides, program=True)
        self.address = f"http://127.0.0.1:{self.port}"

    def until_up(self) -> None:
        """Wait for the first answer."""
        end = time.monotonic() + 180
        while True:
            try:
                return self.status()
            except OSError:
                is_there = self.run.process.exitcode is None
                assert is_there and time.monotonic() < end, self.run.text()
                time.sleep(0.1)

    def status(self) -> dict:
        """Return what /status answers."""
        with urlopen(f"{self.address}/status", timeout=30) as answer:
            return json.load(answer)

    def close(self) -> None:
        """End it, however."""
        self.run.process.kill()
        self.run.process.join()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    made = Server(tmp_path_factory.mktemp("live"))
    try:
        made.until_up()
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def dot() -> np.ndarray:
    return scenes.events()


@pytest.fixture(scope="module")
def page(server):
    if missing := browser.missing():
        pytest.skip(f"no {' and no '.join(missing)} on this machine")
    with browser.browser() as made:
        made.open(server.address)
        yield made


def test_the_page_says_that_it_waits_for_a_stream(page):
    page.wait(STATE.format("waiting"))


def test_pictures_come_and_change(server, page, dot):
    with scenes.Sender(dot, server.events):
        page.wait(STATE.format("playing"))
        page.wait(FRAMES)
        for name in ("frame", "events", "slice"):
            page.wait(f"return document.getElementById('{name}').width > 0")
            before = page.pixels(name)
            until(lambda name=name, before=before: page.pixels(name) != before)
            assert np.std(before) > 1, name
        until(lambda: 0 < server.status()["fps"] < 40)  # frames that were late have caught up
        status = server.status()
    assert status["asked_fps"] == 30
    assert status["events_per_s"] > 1000 and status["views"] == 9
    assert status["latency_ms"]["median"] <= status["latency_ms"]["p99"]


def test_the_slice_follows_a_drag(server, page, dot):
    with scenes.Sender(dot, server.events):
        page.wait(STATE.format("playing"))
        page.drag("line", (0.5, 0.1), (0.5, 0.6))
        until(lambda: page.run("return document.getElementById('slice').height") == 45)
        x0, y0, x1, y1 = server.status()["line"]
    assert abs(x0 - x1) < 1 and x0 == pytest.approx(43.5, abs=1)
    assert (y0, y1) == (pytest.approx(8.3, abs=1), pytest.approx(52.3, abs=1))


def test_pause_pauses_and_play_plays(server, page, dot):
    with scenes.Sender(dot, server.events):
        page.wait(STATE.format("playing"))
        page.click("pause")
        page.wait(STATE.format("paused"))
        time.sleep(0.5)  # what was on its way
        before = page.pixels("frame")
        time.sleep(1.0)
        assert page.pixels("frame") == before
        page.click("pause")
        page.wait(STATE.format("playing"))
        until(lambda: page.pixels("frame") != before)


def test_another_network_on_fewer_views_and_all_views_shown(server, page, dot):
    with scenes.Sender(dot, server.events):
        page.wait(STATE.format("playing"))
        page.run("const s = document.getElementById('network'); s.value = 'setnet_medium';"
                 "s.dispatchEvent(new Event('change'))")  # fmt: skip
        until(lambda: server.status()["network"] == "setnet_medium")
        page.run("const s = document.getElementById('use'); s.value = '3';"
                 "s.dispatchEvent(new Event('change'))")  # fmt: skip
        until(lambda: server.status()["views"] == 3)
        page.click("show-all")
        until(lambda: page.run("return document.getElementById('views').offsetHeight > 50"))
        until(lambda: np.std(page.pixels("views")) > 1)
        page.click("show-all")


def test_a_stream_that_stops_is_told_and_recovers(server, page, dot):
    with scenes.Sender(dot, server.events):
        page.wait(STATE.format("playing"))
    page.wait(STATE.format("stalled"))
    page.wait(FAULT.format("no events for"))
    with scenes.Sender(dot, server.events, first_us=10_000_000):
        page.wait(STATE.format("playing"))
        page.wait(f"return !({FAULT.format('no events for')[7:]})")
        page.wait(FRAMES)


def test_a_stream_that_jumps_back_or_has_another_size_is_told_and_recovers(server, page, dot):
    with scenes.Sender(dot, server.events, first_us=20_000_000):
        page.wait(STATE.format("playing"))
    with scenes.Sender(dot, server.events):
        page.wait(FAULT.format("jumped back by"))
        page.wait(FRAMES)
    with scenes.Sender(dot, server.events, first_us=2_000_000, side=600):
        page.wait(FAULT.format("off the 640x360 sensor"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"no events", ("127.0.0.1", server.events))
    page.wait(FAULT.format("left out"))
    with scenes.Sender(dot, server.events, first_us=4_000_000):
        page.wait(STATE.format("playing"))
        page.wait("return document.getElementById('faults').textContent === ''")
        page.wait(FRAMES)


def test_a_picture_for_those_who_ask_and_none_for_other_sites(server, dot):
    with scenes.Sender(dot, server.events, first_us=6_000_000):
        until(lambda: server.status()["fps"] > 0)
    with urlopen(f"{server.address}/frame.png", timeout=30) as answer:
        picture = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (scenes.SIDE, scenes.SIDE) and picture.dtype == np.uint8
    for headers in ({"Origin": "http://elsewhere.example"}, {"Host": "elsewhere.example"}):
        with pytest.raises(HTTPError) as refused:
            urlopen(Request(f"{server.address}/status", headers=headers), timeout=30)
        refused.value.close()
        assert refused.value.code == 403


def test_on_a_phone_nothing_is_cut_and_a_finger_hits_every_control(server):
    if missing := browser.missing():
        pytest.skip(f"no {' and no '.join(missing)} on this machine")
    with browser.browser() as phone:
        phone.imitate_phone()
        phone.open(server.address)
        phone.wait("return document.getElementById('network').value === 'setnet_medium'")
        width = phone.run("return [innerWidth, document.documentElement.scrollWidth]")
        heights = phone.run(
            "return Array.from(document.querySelectorAll('button, select, label.tick, #contrast'))"
            ".map(one => one.getBoundingClientRect().height)"
        )
    assert width == [390, 390] and len(heights) == 8 and min(heights) >= 44


def test_ctrl_c_leaves_no_process_and_no_port(server):
    assert "this machine only" in server.run.text()
    os.kill(server.run.process.pid, signal.SIGINT)
    assert server.run.wait(60) == 0, server.run.text()
    assert "Traceback" not in server.run.text()
    for port, kind in ((server.port, socket.SOCK_STREAM), (server.events, socket.SOCK_DGRAM)):
        with socket.socket(socket.AF_INET, kind) as again:
            again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            again.bind(("127.0.0.1", port))


def test_a_page_whose_server_is_gone_says_so(server, page):
    page.wait(STATE.format("disconnected"))
    page.wait(FAULT.format("trying again"))
    assert page.run("return document.querySelector('main').inert")
