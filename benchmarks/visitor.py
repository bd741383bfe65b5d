"""What a browser does with the live page, without the browser: python -m benchmarks.visitor PORT

Prints a line for every second: messages and bytes that came.  Imports little, so that it is there
at once and takes next to nothing from what is measured beside it.
"""

import argparse
import asyncio
import time

from aiohttp import ClientSession


async def look(port: int) -> None:
    """Take what the page's stream sends until it closes."""
    async with (
        ClientSession(f"http://127.0.0.1:{port}") as session,
        session.ws_connect("/stream", max_msg_size=2**24) as socket,
    ):
        second, messages, size = time.monotonic(), 0, 0
        async for message in socket:
            await socket.send_str("received")
            messages, size = messages + 1, size + len(message.data)
            if time.monotonic() - second >= 1:
                print(messages, size, flush=True)
                second, messages, size = time.monotonic(), 0, 0


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    asyncio.run(look(parser.parse_args().port))


if __name__ == "__main__":
    main()
