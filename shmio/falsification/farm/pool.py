"""The pool of a search whose trials run on workers of other hosts."""

from __future__ import annotations

import asyncio
import queue
import secrets
import shlex
import threading
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec
from msgspec.structs import replace

from shmio.errors import RemoteError, ShmioError
from shmio.fabric.connection import INSTALL, Access, connect
from shmio.fabric.tasks import end
from shmio.falsification.farm.bundle import Bundle
from shmio.falsification.farm.exchange import (
    BEAT_S,
    KEPT_S,
    NAME,
    OFFERS,
    POLL_S,
    SILENT_S,
    Offer,
    Presence,
    host_name,
    insist,
    open_consumer,
    open_queue,
    open_store,
    result_consumer,
    results_of,
    task_consumer,
    tasks_of,
    try_access,
    workers_of,
)
from shmio.falsification.trial import Result, Task
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

    from shmio.fabric.client import FabricClient

NOBODY_S: Final = 3.0
"""Time in s without a worker after which the user is told."""
CHECK_S: Final = 60.0
"""Interval in s between two checks that the server still has what the workers need."""
END_S: Final = 5.0
"""Maximum time in s to leave the server in order."""
BATCH: Final = 64
MAX_WORKERS: Final = 10_000


class FarmPool:
    """Runs trials on the workers of a farm, as ``Pool`` runs them in processes of this host.

    A thread talks with the server. Each task gets a number of its own, and the first result with
    this number counts. So it does not matter how often a task was delivered.
    """

    def __init__(
        self,
        access: Access,
        bundle: Bundle,
        environment: dict[str, str],
        campaign: str,
        jobs: int,
        limit_s: float,
        tell: Callable[[str], None],
    ) -> None:
        """Prepare the pool. It connects as a context manager.

        Args:
            access: The NATS servers.
            bundle: The files of the trials.
            environment: Versions that workers must have.
            campaign: Name of the campaign file.
            jobs: Maximum number of trials at once, on all workers together.
            limit_s: Maximum duration of a trial, in s of real time.
            tell: Called with lines for the user, by ``wait``.

        """
        self.jobs = jobs
        self._access, self._bundle, self._tell = access, bundle, tell
        search = secrets.token_hex(8)
        self._offer = Offer(
            search,
            host_name(),
            campaign,
            bundle.digest,
            bundle.root,
            bundle.config,
            bundle.folder,
            limit_s,
            environment,
        )
        self._next = 0
        self._running: dict[int, Task] = {}
        self._sent: dict[int, tuple[bytes, float]] = {}
        """Tasks that have no result yet, with the time of their publication. Only the thread uses it."""
        self._found: queue.SimpleQueue[Result | ShmioError | str] = queue.SimpleQueue()
        self._seen: dict[str, tuple[Presence, float]] = {}
        self._refusals: set[str] = set()
        self._lonely_s: float | None = time.monotonic()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="farm", daemon=True)
        self._tasks: list[asyncio.Task[None]] = []
        self._orders: asyncio.Queue[Coroutine[Any, Any, None]] = asyncio.Queue()
        """What the search wants, which is done in its order."""
        self._client: FabricClient | None = None

    # -- the interface of Pool -----------------------------------------------------------------------------------------

    @property
    def idle(self) -> int:
        """Number of trials that can be submitted now."""
        return self.jobs - len(self._running)

    @property
    def workers(self) -> int:
        """Number of workers that serve this search."""
        since_s = time.monotonic() - SILENT_S
        return sum(seen_s > since_s and not one.problem for one, seen_s in list(self._seen.values()))

    def submit(self, task: Task) -> None:
        """Put a trial into the queue. There must be an idle place.

        Raises:
            RemoteError: The trial is larger than a message may be.

        """
        number, self._next = self._next, self._next + 1
        data = msgspec.json.encode(Task(number, self._bundle.portable(task.tables)))
        assert self._client is not None  # noqa: S101  for mypy
        if len(data) > self._client.max_payload:
            raise RemoteError(
                f"{self._access}: a trial has {len(data)} bytes, but a message has at most {self._client.max_payload}; "
                "raise max_payload of the server"
            )
        self._running[number] = task
        self._order(self._publish(number, data))

    def wait(self, timeout_s: float) -> list[Result]:
        """Wait for results, for at most ``timeout_s`` seconds. Return the results that have arrived.

        Raises:
            RemoteError: The server refuses.

        """
        self._look_for_workers()
        found: list[Result] = []
        with suppress(queue.Empty):
            one = self._found.get(timeout=timeout_s)
            while True:
                if isinstance(one, ShmioError):
                    raise one
                if isinstance(one, str):
                    self._tell(one)
                elif (task := self._running.pop(one.number, None)) is not None:
                    found.append(replace(one, number=task.number))
                one = self._found.get_nowait()
        return found

    def cancel(self) -> None:
        """End the trials that are running, without results."""
        self._running.clear()
        self._order(self._withdraw(self._next))

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._do(self._begin())
        except BaseException:
            self._stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    # -- workers -------------------------------------------------------------------------------------------------------

    def _look_for_workers(self) -> None:
        """Tell the user once if there is no worker."""
        now_s = time.monotonic()
        if self.workers:
            self._lonely_s = now_s + SILENT_S  # it may be silent for so long until it is gone
        elif self._lonely_s is not None and now_s - self._lonely_s > NOBODY_S:
            self._lonely_s = None
            self._tell(f"{self._access}: there is no worker; start one on any host: {_worker_command(self._access)}")

    async def _answered(self, message: Msg) -> None:
        try:
            one = msgspec.json.decode(message.data, type=Presence)
        except msgspec.MsgspecError:
            return
        if one.jobs < 1:
            self._seen.pop(one.worker, None)
        elif one.worker in self._seen or len(self._seen) < MAX_WORKERS:
            self._seen[one.worker] = one, time.monotonic()
        said = f"the worker on {one.host} (pid {one.pid}) does not take part: {one.problem}"
        if one.problem and said not in self._refusals and len(self._refusals) < MAX_WORKERS:
            self._refusals.add(said)
            self._found.put(said)

    # -- in the thread -------------------------------------------------------------------------------------------------

    def _do(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _order(self, work: Coroutine[Any, Any, None]) -> None:
        self._loop.call_soon_threadsafe(self._orders.put_nowait, work)

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(self._guarded(work))
        self._tasks.append(task)
        task.add_done_callback(self._tasks.remove)

    async def _guarded(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except ShmioError as error:
            self._found.put(error)
        except Exception as error:  # noqa: BLE001  the search must not wait for ever
            self._found.put(RemoteError(f"{self._access}: {type(error).__name__}: {error}"))

    async def _begin(self) -> None:
        await try_access(self._access)  # fails at once, while the other connection would wait for a server
        self._client = await connect(self._access, "shmio-campaign falsify", lost=self._lost)
        await self._provide()
        search = self._offer.search
        await self._client.subscribe(workers_of(search), cb=self._answered)
        self._start(self._follow_orders())
        self._start(self._offer_often())
        self._start(self._check_often())
        self._start(self._receive())

    async def _lost(self) -> None:
        if not self._offer.over:
            self._found.put(f"{self._access}: the connection is lost; shmio tries to connect again")

    async def _provide(self) -> None:
        """Create what is missing at the server, and publish tasks again that it no longer has."""
        client, search = self._connected(), self._offer.search
        new = await insist(client, lambda _stream: open_queue(client))
        await insist(client, lambda _stream: open_consumer(client, task_consumer(search), tasks_of(search)))
        await insist(client, lambda _stream: open_consumer(client, result_consumer(search), results_of(search)))
        await insist(client, lambda _stream: self._put_bundle())
        old_s = time.monotonic() - KEPT_S / 2
        for number, (data, sent_s) in list(self._sent.items()):
            if new or sent_s < old_s:
                await self._publish(number, data)

    async def _put_bundle(self) -> None:
        errors, store = library("nats.js.errors", INSTALL), await open_store(self._connected())
        try:
            await store.get_info(self._bundle.digest)
        except errors.NotFoundError:
            await store.put(self._bundle.digest, self._bundle.data)

    async def _follow_orders(self) -> None:
        while True:
            await (await self._orders.get())

    async def _publish(self, number: int, data: bytes) -> None:
        if number < self._offer.first:
            return
        self._sent[number] = data, time.monotonic()
        subject = tasks_of(self._offer.search)
        await insist(self._connected(), lambda stream: stream.publish(subject, data))

    async def _withdraw(self, first: int) -> None:
        """Withdraw all tasks before a number."""
        self._offer = replace(self._offer, first=first)
        for number in [number for number in self._sent if number < first]:
            del self._sent[number]
        await self._say()
        await insist(self._connected(), self._purge)

    async def _purge(self, stream: JetStreamContext) -> None:
        with suppress(library("nats.js.errors", INSTALL).NotFoundError):
            await stream.purge_stream(NAME, subject=tasks_of(self._offer.search))

    async def _say(self) -> None:
        errors = library("nats.errors", INSTALL)
        with suppress(errors.Error, OSError):  # while the server is away; the next one follows
            await self._connected().publish(OFFERS, msgspec.json.encode(self._offer))

    async def _offer_often(self) -> None:
        while True:
            await self._say()
            await asyncio.sleep(BEAT_S)

    async def _check_often(self) -> None:
        while True:
            await asyncio.sleep(CHECK_S)
            await self._provide()

    async def _receive(self) -> None:
        """Take the results."""
        errors, client = library("nats.errors", INSTALL), self._connected()
        consumer = await client.jetstream().pull_subscribe_bind(result_consumer(self._offer.search), NAME)
        while not self._offer.over:  # a cancellation can be lost
            try:
                messages = await consumer.fetch(BATCH, timeout=POLL_S)
            except TimeoutError:
                continue
            except (errors.Error, OSError):
                if client.is_closed:
                    raise RemoteError(f"{self._access}: the connection was closed") from None
                await asyncio.sleep(BEAT_S)
                if client.is_connected:
                    await self._provide()  # perhaps the server was replaced by an empty one
                continue
            for message in messages:
                with suppress(msgspec.MsgspecError):
                    result = msgspec.json.decode(message.data, type=Result)
                    if self._sent.pop(result.number, None) is not None:
                        self._found.put(result)
                with suppress(errors.Error, OSError):  # it comes again, and does not count again
                    await message.ack()

    async def _end(self) -> None:
        """Say that the search is over, and remove its part of the queue."""
        client, self._offer = self._client, replace(self._offer, over=True)
        await asyncio.gather(*map(end, self._tasks))
        while not self._orders.empty():
            self._orders.get_nowait().close()
        if client is None:
            return
        search, stream = self._offer.search, client.jetstream()
        with suppress(Exception):
            async with asyncio.timeout(END_S):
                await self._say()
                await stream.delete_consumer(NAME, task_consumer(search))
                await stream.delete_consumer(NAME, result_consumer(search))
                for subject in (tasks_of(search), results_of(search)):
                    await stream.purge_stream(NAME, subject=subject)
        await client.leave(END_S)

    def _connected(self) -> FabricClient:
        assert self._client is not None  # noqa: S101  for mypy
        return self._client

    def _stop(self) -> None:
        with suppress(Exception):
            self._do(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def _worker_command(access: Access) -> str:
    """Return the command that starts a worker for the same servers."""
    words = ["shmio-campaign", "worker", "--farm", ",".join(access.servers)]
    files = msgspec.structs.asdict(access.tls) if access.tls is not None else {}
    for name, file in {"credentials": access.credentials, **files}.items():
        if file is not None:
            words += [f"--{name}", file]
    return shlex.join(words)
