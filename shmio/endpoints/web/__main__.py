"""The process of the HTTP endpoint: serves the web page, or only metrics for Prometheus."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio import worker
from shmio.config import Address, load
from shmio.config.credentials import Secret, read_token, read_tokens
from shmio.config.model import Metrics, Token, Web
from shmio.config.web import check_library
from shmio.endpoints.web.sessions import Sessions
from shmio.errors import ShmioError
from shmio.local.attach import attach
from shmio.logs import fields, rate_limited
from shmio.worker import BEAT_S, Worker

LOGGERS: Final = ("shmio.web", "shmio.fabric", "uvicorn", "asyncio", "websockets", "nats")
"""Loggers whose lines clients can cause in great number. The rate of these lines is limited."""
FOLDERS: Final = "folders"


def run(worker: Worker) -> None:
    """Serve clients until the worker is stopped."""
    check_library(worker.name)
    for name in ("uvicorn", "websockets"):
        logging.getLogger(name).setLevel(logging.WARNING)
    with rate_limited(*LOGGERS):
        asyncio.run(_serve(worker))


async def _serve(worker: Worker) -> None:
    from shmio.endpoints.web.app import PageApp, metrics_app  # noqa: PLC0415  this import needs the extra
    from shmio.endpoints.web.measurements import Measurements  # noqa: PLC0415
    from shmio.endpoints.web.served import Served  # noqa: PLC0415
    from shmio.endpoints.web.server import HttpServer  # noqa: PLC0415
    from shmio.endpoints.web.tabs import TABS  # noqa: PLC0415

    folders: dict[str, str] = worker.config.pop(FOLDERS)
    given = msgspec.convert(worker.config.pop("token", []), list[Token])
    file: str = worker.config.pop("config_file", "")
    recordings: str | None = worker.config.pop("recordings", None)
    scene: dict[str, Any] | None = worker.config.pop("scene", None)
    fabric: dict[str, Any] | None = worker.config.pop("fabric", None)
    config = msgspec.convert(worker.config, Web if worker.name == "web" else Metrics)
    loop = asyncio.get_running_loop()
    stopping = asyncio.Event()
    worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
    measurements = Measurements(worker.segment)
    page = cell = served = None
    sessions = Sessions(_tokens(worker.name, given, config.token_file), config.roles or ())
    if isinstance(config, Web):
        cell = attach(worker.segment.instance, writable=True)
        served = Served(worker.segment, cell, measurements, folders, file, recordings, scene, fabric)
        page = PageApp(served, sessions, TABS, secure=config.certificate is not None)
        app = page.app(measurements, config.registers)
    else:
        app = metrics_app(worker.segment, measurements, folders, config.registers, sessions)
    server = HttpServer(
        app,
        Address.parse(config.listen),
        hosts=tuple(config.hosts),
        sockets=page is not None,
        certificate=config.certificate,
        key=config.key,
    )
    await server.start()
    measurements.start()
    scheme = "https" if config.certificate else "http"
    worker.log.info("the server serves %s://%s/%s", scheme, server.address, "" if page else "metrics")
    worker.on_reread(lambda: loop.call_soon_threadsafe(_take_anew, worker, Path(file), sessions))
    worker.running()
    while not stopping.is_set():
        counters = server.counters
        sent = (0, 0, 0) if page is None else page.counters
        worker.report((counters.requests, counters.refused, counters.connections, *sent, counters.answer_bytes))
        if served is not None:
            worker.report_readers(served.feeds.readers)
        try:
            await asyncio.wait_for(stopping.wait(), BEAT_S)
        except TimeoutError:
            continue
    await server.stop()
    await asyncio.to_thread(measurements.stop)
    if cell is not None:
        cell.close()


def _tokens(name: str, given: Sequence[Token], file: str | None) -> tuple[Secret, ...]:
    """Read the tokens of ``[[grpc.token]]``, and the section's own one from its file."""
    own = () if file is None else (Secret(name, frozenset({"read"}), read_token(name, file)),)
    return read_tokens(given) + own


def _take_anew(worker: Worker, file: Path, sessions: Sessions) -> None:
    """Read the tokens again, and end the sessions of those that are gone."""
    try:
        config = load(file)
        section = config.web if worker.name == "web" else config.metrics
        if section is None:
            return  # the supervisor is about to stop this process
        ended = sessions.take(_tokens(worker.name, config.grpc.token if config.grpc else (), section.token_file))
    except ShmioError as error:
        worker.log.error("the server keeps its tokens as they were: %s", error)
        return
    worker.log.info("the server has read the tokens again", extra=fields(sessions_ended=ended))


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
