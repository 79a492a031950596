"""The web page's plots: CPU of the process ``web``, bytes, and the time from a frame's publication to its arrival.

A source polls an emulated controller at 50 Hz. Pages are WebSocket clients in this process, which follow 20 or 200
registers and decode the times of each batch. A browser adds the time to paint, up to 40 ms, because it draws at 25 Hz.
A page gets batches each 40 ms, so half of that is the least mean delay. *Overruns* are those of the source.
"""

from __future__ import annotations

import asyncio
import json
import struct
import time

from common import begin, quantiles, table
from instance import Instance, instance
from scaling import Usage
from websockets.asyncio.client import ClientConnection, connect

from shmio.testing.ports import reserved_port

PERIOD_MS = 20
_HEAD = struct.Struct("<IId")


async def follow(address: str, paths: list[str], until_s: float) -> tuple[int, list[float]]:
    """Follow registers until a time of CLOCK_MONOTONIC; return the bytes, and the delay of each frame in ms."""
    async with connect(f"ws://{address}/socket", compression=None, max_size=None) as browser:
        await browser.send(json.dumps({"id": 1, "call": "plots.follow", "with": {"source": "cell", "paths": paths}}))
        received, delays, begun_s = 0, list[float](), time.time()
        while (rest_s := until_s - time.monotonic()) > 0:
            message = await _next(browser, rest_s)
            if isinstance(message, str) and "error" in json.loads(message):
                raise SystemExit(message)
            if not isinstance(message, bytes):
                continue
            now_s, rows = time.time(), _HEAD.unpack_from(message)[1]
            times = struct.unpack_from(f"<{rows}d", message, _HEAD.size)
            if times[0] > begun_s:  # the first batches have the past
                delays += (1000 * (now_s - at) for at in times)
                received += len(message)
        return received, delays


async def _next(browser: ClientConnection, timeout_s: float) -> str | bytes | None:
    try:
        return await asyncio.wait_for(browser.recv(), timeout_s)
    except TimeoutError:
        return None


async def measure(running: Instance, address: str, pages: int, signals: int, duration_s: float) -> list[str]:
    """Return a row of the table."""
    paths = [f"cell/Inputs/{number}" for number in range(signals)]
    slot = running.segment.processes.find("cell")
    before = slot.counters["overruns"]
    usage = Usage({"web": [running.pids["web"]]})
    until_s = time.monotonic() + duration_s
    found = await asyncio.gather(*(follow(address, paths, until_s) for _ in range(pages)))
    used = usage.percent()
    cuts = quantiles([delay for _, delays in found for delay in delays])
    return [
        f"{pages} page{'s' * (pages > 1)}, {signals} signals", f"{used['web']:.1f}",
        f"{sum(received for received, _ in found) / pages / duration_s / 1000:.0f}", f"{cuts[0]:.0f}", f"{cuts[2]:.0f}",
        str(slot.counters["overruns"] - before), f"{used['elsewhere']:.0f}",
    ]  # fmt: skip


def main() -> None:
    quick = begin("Plots of the web page at 50 Hz: CPU, bytes and delay")
    with (
        reserved_port() as address,
        instance(PERIOD_MS, more=f'[web]\nlisten = "{address}"\n') as running,
    ):
        rows = [
            asyncio.run(measure(running, str(address), pages, signals, 2.0 if quick else 20.0))
            for pages in (1, 10)
            for signals in (20, 200)
        ]
    titles = ["", "web, % of a core", "kB/s a page", "frame to page, ms", "p99", "overruns", "others, % of a core"]
    table(titles, rows)


if __name__ == "__main__":
    main()
