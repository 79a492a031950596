"""The process of the HTTP endpoint."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

import msgspec

from shmio import worker
from shmio.config import Address
from shmio.config.model import Metrics
from shmio.config.web import check_library
from shmio.logs import LogRateLimit
from shmio.worker import BEAT_S, Worker

LOGGERS: Final = ("shmio.web", "uvicorn", "asyncio")
"""Loggers of lines that clients can cause. The rate of these lines is limited."""
FOLDERS: Final = "folders"


def run(worker: Worker) -> None:
    """Serve clients until the worker is stopped."""
    check_library()
    limits = {name: LogRateLimit(one_kind=name != "shmio.web") for name in LOGGERS}
    for name, limit in limits.items():
        logging.getLogger(name).addFilter(limit)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    try:
        asyncio.run(_serve(worker))
    finally:
        for name, limit in limits.items():
            logging.getLogger(name).removeFilter(limit)


async def _serve(worker: Worker) -> None:
    from shmio.endpoints.web.app import metrics_app  # noqa: PLC0415  it needs the extra
    from shmio.endpoints.web.measurements import Measurements  # noqa: PLC0415
    from shmio.endpoints.web.server import HttpServer  # noqa: PLC0415

    folders: dict[str, str] = worker.config.pop(FOLDERS)
    config = msgspec.convert(worker.config, Metrics)
    loop = asyncio.get_running_loop()
    stopping = asyncio.Event()
    worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
    measurements = Measurements(worker.segment)
    app = metrics_app(worker.segment, measurements, folders, config.registers)
    server = HttpServer(
        app,
        Address.parse(config.listen),
        hosts=tuple(config.hosts),
        certificate=config.certificate,
        key=config.key,
    )
    await server.start()
    measurements.start()
    worker.log.info("serving %s://%s/metrics", "https" if config.certificate else "http", server.address)
    worker.running()
    while not stopping.is_set():
        counters = server.counters
        worker.report((counters.requests, counters.refused, counters.connections))
        try:
            await asyncio.wait_for(stopping.wait(), BEAT_S)
        except TimeoutError:
            continue
    await server.stop()
    await asyncio.to_thread(measurements.stop)


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
