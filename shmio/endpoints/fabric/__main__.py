"""The two processes of the fabric: the uplink, and the embedded NATS server."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import msgspec

from shmio import worker
from shmio.endpoints.fabric.server import NatsServer, ServerSettings
from shmio.endpoints.server_process import serve
from shmio.fabric.tasks import end
from shmio.logs import log_loop_errors, rate_limited
from shmio.worker import BEAT_S, Worker

if TYPE_CHECKING:
    from shmio.endpoints.fabric.uplink import Uplink

SERVER: Final = "nats"
"""Name of the process of the embedded server."""
ATTEMPT_S: Final = 3.0
"""Longest time in s for which the process waits for a server before it reports that it runs."""
LOGGERS: Final = ("shmio.fabric", "nats", "asyncio")
"""Loggers that others can flood. The rate of their lines is limited."""

log = logging.getLogger("shmio.fabric")


def run(worker: Worker) -> None:
    """Run the uplink or the server, depending on the worker's name, until the worker is stopped."""
    with rate_limited(*LOGGERS):
        if worker.name == SERVER:
            _serve(worker)
        else:
            asyncio.run(_publish(worker))


def _serve(worker: Worker) -> None:
    settings = msgspec.convert(worker.config, ServerSettings)
    serve(worker, NatsServer(settings, worker.segment.instance), f"nats-server serves NATS on {settings.listen}")


async def _publish(worker: Worker) -> None:
    from shmio.endpoints.fabric.uplink import Uplink, UplinkSettings  # noqa: PLC0415  the server does not need it

    loop = asyncio.get_running_loop()
    log_loop_errors(loop)
    stopping = asyncio.Event()
    worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
    uplink = Uplink(worker.segment, worker.slot, msgspec.convert(worker.config, UplinkSettings))
    starting = loop.create_task(uplink.start())
    while not starting.done():  # a large layout must not stop the heartbeat
        await asyncio.wait((starting,), timeout=BEAT_S)
        worker.report()
    starting.result()
    running = loop.create_task(uplink.run())
    try:
        await _first_attempt(worker, uplink, running, stopping)
        worker.running()
        while not stopping.is_set():
            uplink.follow_start()
            uplink.follow_reloads()
            worker.report(uplink.counters, note=uplink.problem)
            worker.report_readers(uplink.readers)
            if running.done():
                running.result()
            with suppress(TimeoutError):
                await asyncio.wait_for(stopping.wait(), BEAT_S)
    finally:
        await end(running)
        await uplink.close()
    worker.report(uplink.counters, note="")
    log.info("the uplink has stopped; it sent %d messages", uplink.publisher.sent)


async def _first_attempt(worker: Worker, uplink: Uplink, running: asyncio.Task[None], stopping: asyncio.Event) -> None:
    """Wait until the uplink publishes, or knows why it does not, so that a start that is refused fails.

    Raises:
        ConfigError: The uplink can never publish as configured.

    """
    begun_s = time.monotonic()
    trying = asyncio.create_task(uplink.tried.wait())
    try:
        while not (stopping.is_set() or time.monotonic() - begun_s > ATTEMPT_S):
            done, _ = await asyncio.wait((trying, running), timeout=BEAT_S, return_when=asyncio.FIRST_COMPLETED)
            worker.report(uplink.counters, note=uplink.problem)
            if running in done:
                running.result()
            if done:
                return
    finally:
        await end(trying)


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
