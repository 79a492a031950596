"""MTConnect: values a second and CPU of the example's connector ``mtconnect``, beside a bare client of the same agent.

An agent in a process of its own gives all data items a new value, and sends them in one document of its stream, again
as soon as the client has it. The clients take turns in this process. The bare client reads the stream with urllib,
parses each document with ElementTree, and makes a float of each observation. The connector also limits what it
accepts, and puts each value with its status and time into an image, which it makes 100 times a second.
"""

from __future__ import annotations

import sys
import threading
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack, suppress
from xml.etree import ElementTree

from common import ROOT, Child, Connect, begin, compare_clients, follow

from shmio.layout.tags import place_tags
from shmio.layout.values.codec import codec

sys.path.insert(0, str(ROOT / "examples/mtconnect/src"))
from shmio_mtconnect.connector import MTConnectConnector, MTConnectOptions

PERIOD_S = 0.01
Newest = Callable[[], object]
"""Returns the newest number from the last data item."""


def connector(stack: ExitStack, port: int, items: int) -> Newest:
    """Connect the connector."""
    layout = place_tags("bench", {f"v{n}": {"type": "REAL", "address": f"v{n}"} for n in range(items)}).with_statuses()
    made = MTConnectConnector(MTConnectOptions(url=f"http://127.0.0.1:{port}", interval=1, count=items), layout)
    made.connect()
    stack.callback(made.close)
    last = codec(layout.registers[-1], layout.byte_order)

    return lambda: last.decode(made.read())


def library(stack: ExitStack, port: int, items: int) -> Newest:
    """Connect the bare client."""
    values: dict[str, float] = {}
    answer = urllib.request.urlopen(f"http://127.0.0.1:{port}/sample?interval=1&count={items}", timeout=5)

    def follow() -> None:
        size = 0
        with suppress(OSError, ValueError, AttributeError):  # the main thread has closed the stream
            while line := answer.readline():
                if line.lower().startswith(b"content-length:"):
                    size = int(line.split(b":")[1])
                elif line == b"\r\n" and size:
                    for one in ElementTree.fromstring(answer.read(size)).iter():
                        if (name := one.get("dataItemId")) is not None:
                            values[name] = float(one.text or "nan")
                    size = 0

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    stack.callback(thread.join, 5)
    stack.callback(answer.close)
    last = f"v{items - 1}"

    def newest() -> float | None:
        if not thread.is_alive():
            raise SystemExit("the stream of the bare client has ended")
        return values.get(last)

    return newest


def compare(items: int, rounds: int, round_s: float) -> None:
    """Print the table for so many data items."""
    with Child("mtconnect_peer.py", items) as agent:
        clients: dict[str, Connect] = {
            "shmio": lambda stack: follow(agent, connector(stack, agent.hello, items), PERIOD_S),
            "urllib, ElementTree": lambda stack: follow(agent, library(stack, agent.hello, items), PERIOD_S),
        }
        compare_clients(f"{items} data items", clients, items, rounds, round_s)


def main() -> None:
    quick = begin("MTConnect: values a second of the connector and of a client of urllib and ElementTree")
    for items in (100,) if quick else (100, 1000):
        compare(items, *((1, 0.3) if quick else (5, 2.0)))


if __name__ == "__main__":
    main()
