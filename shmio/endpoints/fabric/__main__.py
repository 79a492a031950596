"""The two processes of the fabric: the uplink, and the embedded NATS server."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import Final

import msgspec

from shmio import worker
from shmio.endpoints.fabric.server import NatsServer, ServerSettings
from shmio.endpoints.server_process import serve
from shmio.fabric.tasks import end
from shmio.logs import LogRateLimit
from shmio.worker import BEAT_S, Worker

SERVER: Final = "nats"
"""Name of the process of the embedded server."""
LOGGERS: Final = ("shmio.fabric", "nats", "asyncio")
"""Loggers that others can flood. The rate of their lines is limited."""

log = logging.getLogger("shmio.fabric")


def run(worker: Worker) -> None:
    """Run the uplink or the server, depending on the worker's name, until the worker is stopped."""
    limits = {name: LogRateLimit(one_kind=name != "shmio.fabric") for name in LOGGERS}
    for name, limit in limits.items():
        logging.getLogger(name).addFilter(limit)
    try:
        if worker.name == SERVER:
            _serve(worker)
        else:
            asyncio.run(_publish(worker))
    finally:
        for name, limit in limits.items():
            logging.getLogger(name).removeFilter(limit)


def _serve(worker: Worker) -> None:
    settings = msgspec.convert(worker.config, ServerSettings)
    serve(worker, NatsServer(settings, worker.segment.instance), f"nats-server serves NATS on {settings.listen}")


async def _publish(worker: Worker) -> None:
    from shmio.endpoints.fabric.uplink import Uplink, UplinkSettings  # noqa: PLC0415  the server does not need it

    loop = asyncio.get_running_loop()
    stopping = asyncio.Event()
    worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
    uplink = Uplink(worker.segment, worker.slot, msgspec.convert(worker.config, UplinkSettings))
    starting = loop.create_task(uplink.start())
    while not starting.done():  # a large layout must not stop the heartbeat
        await asyncio.wait((starting,), timeout=BEAT_S)
        worker.report()
    starting.result()
    worker.running()
    running = loop.create_task(uplink.run())
    try:
        while not stopping.is_set():
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


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
