"""The process of the gRPC endpoint."""

from __future__ import annotations

import asyncio

import msgspec

from shmio import worker
from shmio.config import Address, Grpc
from shmio.endpoints.grpc.feeds import Feeds
from shmio.endpoints.grpc.hold import Hold
from shmio.endpoints.grpc.server import Server
from shmio.endpoints.grpc.services import Services
from shmio.errors import SegmentError
from shmio.logs import fields
from shmio.worker import BEAT_S, Worker


def run(worker: Worker) -> None:
    """Serve until told to stop."""
    asyncio.run(_serve(worker))


async def _serve(worker: Worker) -> None:
    loop = asyncio.get_running_loop()
    stopping = asyncio.Event()
    worker.on_stop(lambda: loop.call_soon_threadsafe(stopping.set))
    config = msgspec.convert(worker.config, Grpc)
    tasks: set[asyncio.Task[None]] = set()
    good_ones: set[str] = set()
    writer = worker.slot.writer
    if writer is None:
        raise SegmentError("the segment has no command queue for this process")

    def on_quality(source: str, good: bool) -> None:
        if good != (source in good_ones):
            worker.log.info("source %s", "good" if good else "bad", extra=fields(source=source))
            good_ones.symmetric_difference_update({source})
        task = loop.create_task(server.set_source(source, good))
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    hold = Hold()
    feeds = Feeds(worker.segment, writer, loop, on_quality, hold)
    services = Services(worker.segment, worker.slot, hold, feeds, config.default_source)
    server = Server(services)
    feeds.start()
    await services.stepper.start()
    addresses = [Address.parse(text) for text in config.listen]
    ports = await server.start(addresses, config.tls)
    served = ", ".join(str(Address(address.host, port)) for address, port in zip(addresses, ports, strict=True))
    worker.log.info("serving %s", served)
    worker.running()
    reading: asyncio.Task[list[str]] | None = None
    while not stopping.is_set():
        reading = reading or loop.create_task(feeds.follow())
        await asyncio.wait((reading,), timeout=BEAT_S)  # big layouts take longer than a hang: it beats meanwhile
        if reading.done():
            if changed := reading.result():
                worker.log.info("a reload added, changed or ended %s", ", ".join(changed))
                services.move(changed)
            reading = None
        if not (feeds.alive and services.stepper.alive):
            raise RuntimeError("a thread ended that should not have; the endpoint starts anew")
        streams, dropped, published, refused = services.counters
        worker.report((streams, feeds.messages, dropped, published, refused))
        try:
            await asyncio.wait_for(stopping.wait(), BEAT_S)
        except TimeoutError:
            continue
    if reading is not None:
        reading.cancel()
    feeds.stop()
    await services.stepper.stop()
    await server.stop()
    feeds.join()
    services.stepper.join()


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
