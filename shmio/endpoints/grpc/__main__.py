"""The process of the gRPC endpoint."""

from __future__ import annotations

import asyncio
import grp
import logging
import os
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

import msgspec

from shmio import worker
from shmio.audit.trail import close_trail
from shmio.config import Address, Grpc, load
from shmio.endpoints.grpc.server import limits
from shmio.endpoints.grpc.server.access import Listeners
from shmio.endpoints.grpc.server.server import Server
from shmio.endpoints.grpc.services.services import Services
from shmio.endpoints.grpc.streams.feed import Feeds, VirtualTime
from shmio.endpoints.grpc.wakeups import WakeUps
from shmio.errors import SegmentError, ShmioError
from shmio.logs import fields, log_loop_errors, rate_limited
from shmio.worker import BEAT_S, Worker

CALLS_S: Final = 1.0
LOGGERS: Final = ("shmio.grpc", "asyncio", "grpc._cython.cygrpc")
"""Loggers whose lines clients can cause in great number. The rate of these lines is limited."""


def run(worker: Worker) -> None:
    """Serve clients until the worker is stopped."""
    limits.limit_arenas()
    with rate_limited(*LOGGERS):
        asyncio.run(_serve(worker))


async def _serve(worker: Worker) -> None:
    loop = asyncio.get_running_loop()
    log_loop_errors(loop)
    stopping = asyncio.Event()
    rereading = asyncio.Lock()
    worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
    config, place = _settings(worker)
    listeners = Listeners(config)
    tasks: set[asyncio.Task[None]] = set()
    good_ones: set[str] = set()
    writer = worker.slot.writer
    if writer is None:
        raise SegmentError("the segment has no command queue for this process")

    def on_quality(source: str, good: bool) -> None:
        if good != (source in good_ones):
            worker.log.info("the source %s is %s", source, "good" if good else "bad", extra=fields(source=source))
            good_ones.symmetric_difference_update({source})
        task = loop.create_task(server.set_source(source, good))
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    def reread(file: Path) -> None:
        task = loop.create_task(_take_anew(worker, file, listeners, server, rereading))
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    trimmer = limits.Trimmer()
    virtual_time = VirtualTime()
    wake_ups = WakeUps()
    feeds = Feeds(worker.segment, writer, wake_ups, on_quality, virtual_time)
    services = Services(worker.segment, worker.slot, virtual_time, wake_ups, feeds, config.default_source)
    server = Server(services.calls)
    feeds.start()
    await services.stepper.start(worker.before.pid)
    ports = await server.start(listeners.listeners, config.tls, place.gid)
    addresses = [listener.address for listener in listeners.listeners]
    served = [
        str(Address(address.host, port) if isinstance(address, Address) else address)
        for address, port in zip(addresses, ports, strict=True)
    ]
    worker.log.info("the endpoint serves %s", ", ".join(served))
    if server.shortage:
        worker.report(note=server.shortage)
    if (file := place.config_file) is not None:
        worker.on_reread(lambda: loop.call_soon_threadsafe(reread, file))
    worker.running()
    reading: asyncio.Task[None] | None = None
    while not stopping.is_set():
        reading = reading or loop.create_task(_follow(worker, feeds, services))
        await asyncio.wait((reading,), timeout=BEAT_S)  # reading a large layout must not stop the heartbeat
        if reading.done():
            reading.result()
            reading = None
        if not server.alive:
            _end_now(worker)
        if not (feeds.alive and services.stepper.alive):
            raise RuntimeError("a task ended unexpectedly; the endpoint restarts")
        trimmer.trim(server.unknown)
        services.stepper.timeline.update()
        streams, dropped, published, refused = services.counters
        messages = feeds.messages + services.updates
        sent = server.calls.sent_bytes
        worker.report((streams, messages, dropped, published, refused, sent, services.waiting_bytes))
        worker.report_readers((*feeds.readers, *services.readers))
        try:
            await asyncio.wait_for(stopping.wait(), BEAT_S)
        except TimeoutError:
            continue
    if reading is not None:
        reading.cancel()
    feeds.stop()
    await services.stepper.stop()
    await server.stop()
    await _calls_end()
    wake_ups.close()


async def _follow(worker: Worker, feeds: Feeds, services: Services) -> None:
    """Adopt the changes of a reload.

    No call may start after the feeds have changed and before the services' streams have moved.
    """
    if changed := await feeds.follow():
        worker.log.info("a reload added, changed or removed %s", ", ".join(changed))
        services.on_sources_replaced(changed)


def _end_now(worker: Worker) -> NoReturn:
    """End the process without cleaning up, because gRPC has stopped serving.

    A clean-up would free memory that gRPC's threads still write to.
    """
    worker.log.error("gRPC stopped serving; this process ends, and the supervisor starts a new one")
    logging.shutdown()
    close_trail()
    os._exit(1)


async def _calls_end() -> None:
    """Wait for the calls that are ending; each would otherwise log a traceback when the loop ends."""
    if calls := asyncio.all_tasks() - {asyncio.current_task()}:
        await asyncio.wait(calls, timeout=CALLS_S)


class _Place(NamedTuple):
    """Settings of the instance that are not in its ``[grpc]`` section."""

    config_file: Path | None
    gid: int | None


def _settings(worker: Worker) -> tuple[Grpc, _Place]:
    config = dict(worker.config)
    file, group = config.pop("config_file", None), config.pop("group", None)
    place = _Place(file and Path(file), None if group is None else grp.getgrnam(group).gr_gid)
    return msgspec.convert(config, Grpc), place


async def _take_anew(worker: Worker, file: Path, listeners: Listeners, server: Server, lock: asyncio.Lock) -> None:
    """Reload tokens and roles, and end the calls that they no longer allow."""
    async with lock:  # one reload at a time: the last one must win
        try:
            config = await asyncio.to_thread(load, file)
            if config.grpc is None:
                return  # the supervisor is about to stop this process
            listeners.take(config.grpc)
        except ShmioError as error:
            worker.log.error("the endpoint keeps its tokens and roles as they were: %s", error)
            return
        ended = server.calls.review()
    if not (ended or config.grpc.guarded):
        return  # no tokens are in use, so there is nothing to report
    worker.log.info(
        "the endpoint has reloaded tokens and roles", extra=fields(tokens=len(config.grpc.token), calls_ended=ended)
    )


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
