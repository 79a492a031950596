"""The web page's plots: CPU of the process ``web``, bytes, and the time from a frame's publication to its picture.

A source polls an emulated controller at 50 Hz. Pages are WebSocket clients in this process, which follow 20 or 200
registers and decode the times of each batch. A page gets batches each 40 ms, so half of that is the least mean delay.
In the row with silent WebSockets, 500 others are opened beside the page, and again whenever the server closes them.
*Overruns* are those of the source.

``paint``: in headless Chromium, from a frame's publication to the end of the browser frame in which the plot with it
was drawn. ``fps``: how often the plots were drawn in a second. Chromium draws on the same cores, without a GPU.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import struct
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from common import begin, quantiles, table
from instance import Instance, instance
from scaling import Usage
from websockets.asyncio.client import ClientConnection, connect

from shmio.testing.ports import reserved_port

PERIOD_MS = 20
SILENT = 500
PAINT_S = 15.0
_HEAD = struct.Struct("<IId")
_UPGRADE = (
    "GET /socket HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
_WATCH = """paths => {
  sessionStorage.setItem("plots", JSON.stringify(paths.map(path => [path])));
  location.hash = "plots";
  let waiting = [], drawn = false;
  window.delays = [];
  window.drawings = 0;
  const begun_s = Date.now() / 1000;
  window.WebSocket = class extends WebSocket {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", ({ data }) => {
        if (!(data instanceof ArrayBuffer)) return;
        const rows = new DataView(data).getUint32(4, true);
        const times = new Float64Array(data.slice(16, 16 + 8 * rows));
        waiting.push(...times.filter(time => time > begun_s + 3)); // the page has settled
      });
    }
  };
  const { stroke } = CanvasRenderingContext2D.prototype;
  CanvasRenderingContext2D.prototype.stroke = function (...given) {
    stroke.apply(this, given);
    if (drawn) return;
    drawn = true;
    const shown = waiting;
    waiting = [];
    requestAnimationFrame(() => {
      drawn = false;
      if (shown.length) window.drawings += 1;
      window.delays.push(...shown.map(time => Date.now() - 1000 * time));
    });
  };
}"""


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


@asynccontextmanager
async def silent(address: str, count: int) -> AsyncIterator[None]:
    """Keep a number of WebSockets open that send nothing. The server closes them; each is then opened again."""
    host, _, port = address.rpartition(":")

    async def keep() -> None:
        while True:
            with suppress(OSError):
                reader, writer = await asyncio.open_connection(host, int(port))
                writer.write(_UPGRADE.format(address).encode())
                await reader.read()
                writer.close()
            await asyncio.sleep(1)

    tasks = [asyncio.create_task(keep()) for _ in range(count)]
    try:
        await asyncio.sleep(1)
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def measure(
    running: Instance, address: str, pages: int, signals: int, duration_s: float, others: int = 0
) -> list[str]:
    """Return a row of the table."""
    async with silent(address, others):
        row = await _measured(running, address, pages, signals, duration_s)
    row[0] += f", {others} silent" * bool(others)
    return row


async def _measured(running: Instance, address: str, pages: int, signals: int, duration_s: float) -> list[str]:
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


def paint(running: Instance, address: str, signals: int, duration_s: float) -> list[str]:
    """Return a row of the table of the browser."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  it need not be installed

    slot = running.segment.processes.find("cell")
    before = slot.counters["overruns"]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(f"({_WATCH})({json.dumps([f'cell/Inputs/{number}' for number in range(signals)])})")
        page.goto(f"http://{address}/")
        while not page.evaluate("window.delays.length"):
            page.wait_for_timeout(100)
        page.evaluate("window.delays = []; window.drawings = 0")
        usage = Usage({"web": [running.pids["web"]]})
        page.wait_for_timeout(1000 * duration_s)
        delays, drawings = page.evaluate("[window.delays, window.drawings]")
        used = usage.percent()
        browser.close()
    cuts = quantiles(delays)
    return [
        f"Chromium, {signals} signals", f"{used['web']:.1f}", f"{cuts[0]:.0f}", f"{cuts[2]:.0f}",
        f"{drawings / duration_s:.0f}", str(slot.counters["overruns"] - before), f"{used['elsewhere']:.0f}",
    ]  # fmt: skip


def main() -> None:
    quick = begin("Plots of the web page at 50 Hz: CPU, bytes and delay")
    titles = ["", "web, % of a core", "kB/s a page", "frame to page, ms", "p99", "overruns", "others, % of a core"]
    with (
        reserved_port() as address,
        instance(PERIOD_MS, more=f'[web]\nlisten = "{address}"\n') as running,
    ):
        rows = [
            asyncio.run(measure(running, str(address), pages, signals, 2.0 if quick else 20.0))
            for pages in (1, 10)
            for signals in (20, 200)
        ]
        rows.append(asyncio.run(measure(running, str(address), 1, 20, 2.0 if quick else 20.0, SILENT)))
        table(titles, rows)
        painted = []
        if shutil.which("chromium") is not None:
            painted = [paint(running, str(address), signals, 2.0 if quick else PAINT_S) for signals in (20, 200)]
    if painted:
        table(["", "web, % of a core", "paint, ms", "p99", "fps", "overruns", "others, % of a core"], painted)


if __name__ == "__main__":
    main()
