"""The process of the OPC UA endpoint."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
from typing import Final

import msgspec

from shmio import worker
from shmio.config import OpcUa
from shmio.config.opcua import EXTRA
from shmio.errors import ConfigError
from shmio.logs import log_loop_errors, rate_limited
from shmio.worker import BEAT_S, Worker

LOGGERS: Final = ("shmio.opcua", "asyncua", "asyncio")
"""Loggers whose lines clients can cause in great number. The rate of these lines is limited."""


def run(worker: Worker) -> None:
    """Serve clients until the worker is stopped."""
    if importlib.util.find_spec("asyncua") is None:
        raise ConfigError(EXTRA)
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # it logs every request of every client
    with rate_limited(*LOGGERS):
        asyncio.run(_serve(worker))


async def _serve(worker: Worker) -> None:
    from shmio.endpoints.opcua.endpoint import Endpoint  # noqa: PLC0415  this import needs the extra

    loop = asyncio.get_running_loop()
    log_loop_errors(loop)
    stopping = asyncio.Event()
    worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
    endpoint = Endpoint(worker.segment, worker.slot, msgspec.convert(worker.config, OpcUa))
    starting = loop.create_task(endpoint.start())
    while not starting.done():  # creating many nodes must not stop the heartbeat
        await asyncio.wait((starting,), timeout=BEAT_S)
        worker.report()
    starting.result()
    worker.log.info("the server serves opc.tcp://%s", endpoint.server.address)
    worker.running()
    while not stopping.is_set():
        endpoint.follow_reloads()
        worker.report(endpoint.counters)
        worker.report_readers(endpoint.readers)
        try:
            await asyncio.wait_for(stopping.wait(), BEAT_S)
        except TimeoutError:
            continue
    await endpoint.stop()


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
