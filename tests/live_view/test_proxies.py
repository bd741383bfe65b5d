"""The live page behind a proxy: its stream is for the sites that are named, and for no others."""

import asyncio
import socket

import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from src.live_view.page_server import LivePage, PageServer, find_page_address


@pytest.fixture(scope="module")
def proxied():
    """The requests that a page answers which is served at https://cam.example.org too."""
    origins = ["https://cam.example.org/"]
    return PageServer(LivePage.__new__(LivePage), "127.0.0.1", 8600, origins)


@pytest.mark.parametrize(
    ("headers", "answered"),
    [
        ({"Origin": "https://cam.example.org"}, True),
        ({"Origin": "https://cam.example.org", "Host": "cam.example.org"}, True),
        ({"Host": "cam.example.org"}, True),
        ({"Origin": "https://elsewhere.example", "Host": "cam.example.org"}, False),
        ({"Origin": "http://cam.example.org.elsewhere.example"}, False),
        ({"Host": "elsewhere.example"}, False),
    ],
)
def test_a_proxy_that_is_named_may_use_the_stream(proxied, headers, answered):
    async def answer(request):
        return web.Response(text="answered")

    request = make_mocked_request("GET", "/stream", {"Host": "127.0.0.1:8600"} | headers)
    asked = proxied._own_pages_only(request, answer)
    if answered:
        assert asyncio.run(asked).text == "answered"
    else:
        with pytest.raises(web.HTTPForbidden):
            asyncio.run(asked)


@pytest.mark.parametrize(
    ("headers", "answered"),
    [
        ({"Host": "192.168.1.7:8600"}, True),
        ({"Host": "[fe80::1]:8600"}, True),
        ({"Host": f"{socket.gethostname()}:8600"}, True),
        ({"Host": "localhost:8600"}, True),
        ({"Host": "cam.example.org"}, True),
        ({"Host": "192.168.1.7:8600", "Origin": "http://192.168.1.7:8600"}, True),
        ({"Host": "192.168.1.7:8600", "Origin": "http://elsewhere.example"}, False),
        ({"Host": "elsewhere.example:8600", "Origin": "http://elsewhere.example:8600"}, False),
        ({"Host": "elsewhere.example:8600"}, False),
    ],
)
def test_a_page_for_other_machines_answers_to_its_addresses_and_names(headers, answered):
    opened = PageServer(LivePage.__new__(LivePage), "0.0.0.0", 8600, ["https://cam.example.org"])
    test_a_proxy_that_is_named_may_use_the_stream(opened, headers, answered)


def test_the_address_that_is_printed_can_be_opened():
    host = find_page_address("0.0.0.0", 8600).removeprefix("http://").rpartition(":")[0]
    assert host not in ("", "0.0.0.0") and find_page_address("127.0.0.1", 1) == "http://127.0.0.1:1"
    assert find_page_address("::1", 80) == "http://[::1]:80"


def test_the_page_of_a_proxy_may_open_its_stream(proxied):
    request = make_mocked_request("GET", "/", {"Host": "127.0.0.1:8600"})
    policy = asyncio.run(proxied._page(request)).headers["Content-Security-Policy"]
    assert (
        "connect-src 'self' ws://127.0.0.1:8600 ws://cam.example.org wss://cam.example.org"
        in policy
    )
    with pytest.raises(ValueError, match="allowed_origins must be addresses such as"):
        PageServer(LivePage.__new__(LivePage), "127.0.0.1", 8600, ["cam.example.org"])
