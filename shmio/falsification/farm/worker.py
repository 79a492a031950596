"""A worker: runs the trials of all searches that use its NATS server.

It offers no service of its own: it connects to the server, takes tasks from the work queue, and
runs each in a process of this host, as a search without a farm does.
"""

from __future__ import annotations

import asyncio
import fcntl
import hashlib
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from io import RawIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from shmio.errors import RemoteError, ShmioError
from shmio.fabric.connection import INSTALL, Access, call, connect_or_stop
from shmio.fabric.tasks import end
from shmio.falsification.farm.bundle import MAX_BYTES, place_in, unpack
from shmio.falsification.farm.environment import differences
from shmio.falsification.farm.exchange import (
    BEAT_S,
    MAX_DELIVERIES,
    NAME,
    OFFERS,
    OVER_S,
    POLL_S,
    Offer,
    Presence,
    contact,
    host_name,
    insist,
    open_store,
    results_of,
    task_consumer,
    try_access,
    workers_of,
)
from shmio.falsification.pool import Pool
from shmio.falsification.trial import Result, Task
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

    from shmio.fabric.client import FabricClient

PREFIX: Final = "shmio-farm-"
"""Beginning of the name of a worker's folder."""
MAX_SEARCHES: Final = 16
MANY_S: Final = 0.5
"""Maximum time in s that a slot waits for a task of one search, while there are others."""
FETCH_S: Final = 300.0
"""Maximum time in s to fetch a bundle."""
LEAVE_S: Final = 5.0
"""Maximum time in s until the server has taken what waits at the end."""
LOOK_S: Final = 0.25
"""Maximum time in s between two checks whether a trial is still wanted."""


@dataclass
class _Search:
    """A search that the worker knows."""

    offer: Offer
    heard_s: float
    place: Path
    """Folder of its files."""
    problem: str = ""
    over: bool = False
    serving: asyncio.Task[None] | None = None
    running: set[asyncio.Task[None]] = field(default_factory=set)
    trials: int = 0


class _Slot:
    """Runs one trial at a time, in a process for each search. Its thread is the parent of these processes."""

    def __init__(self) -> None:
        self.thread = ThreadPoolExecutor(1, thread_name_prefix="slot")
        self._pools: dict[str, Pool] = {}

    def run(self, search: _Search, task: Task, stop: asyncio.Event) -> Result | None:
        """Run a trial; return None if nobody wants its result any more."""
        pool = self._pools.get(search.offer.search)
        if pool is None:
            offer = search.offer
            config = place_in(search.place, offer.config)
            pool = Pool(config, place_in(search.place, offer.folder), 1, offer.limit_s, config.parent)
            self._pools[offer.search] = pool
        pool.submit(task)
        while not (found := pool.wait(LOOK_S)):
            if search.over or task.number < search.offer.first or stop.is_set():
                pool.cancel()
                return None
        return found[0]

    def forget(self, search: str) -> None:
        """End the process of a search."""
        if pool := self._pools.pop(search, None):
            pool.__exit__()

    def close(self) -> None:
        """End all processes."""
        for search in list(self._pools):
            self.forget(search)


class Worker:
    """Serves all searches that it hears of."""

    def __init__(self, access: Access, jobs: int, folder: Path, tell: Callable[[str], None]) -> None:
        """Prepare the worker.

        Args:
            access: The NATS servers.
            jobs: Maximum number of trials at once.
            folder: A folder that only this user can enter, for the files of searches.
            tell: Called with lines for the user.

        """
        self._access, self._jobs, self._folder, self._tell = access, jobs, folder, tell
        self._id, self._host = secrets.token_hex(8), host_name()
        self._searches: dict[str, _Search] = {}
        self._slots: asyncio.Queue[_Slot] = asyncio.Queue()
        self._all = [_Slot() for _ in range(jobs)]
        self._stop = asyncio.Event()
        self._clearing: set[asyncio.Task[None]] = set()
        self._client: FabricClient

    async def run(self, stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set. Then give the running trials back to the queue.

        Raises:
            ConfigError: A file of the access cannot be used, or the user needs other credentials.
            RemoteError: The server refuses access.

        """
        with suppress(RemoteError):  # the other connection tries again, and logs why
            await try_access(self._access)
        client = await connect_or_stop(self._access, "shmio-campaign worker", stop, lost=self._lost, back=self._back)
        if client is None:
            return
        self._client = client
        try:
            await call(self._access, self._client, contact)
            for slot in self._all:
                self._slots.put_nowait(slot)
            await self._client.subscribe(OFFERS, cb=self._hear)
            await self._client.flush()
            self._tell(f"connected to {self._access}: {self._jobs} trials at once; waiting for searches")
            while not stop.is_set():
                if self._client.is_closed:
                    raise RemoteError(f"{self._access}: the server closed the connection, and refuses another one")
                await self._beat()
                with suppress(TimeoutError):
                    await asyncio.wait_for(stop.wait(), BEAT_S)
        finally:
            await self._close()

    async def _lost(self) -> None:
        if not self._stop.is_set():
            self._tell(f"{self._access}: the connection is lost; shmio tries to connect again")

    async def _back(self) -> None:
        self._tell(f"{self._access}: connected again")
        for search in self._searches.values():  # their offers could not arrive
            search.heard_s = time.monotonic()

    # -- searches ------------------------------------------------------------------------------------------------------

    async def _hear(self, message: Msg) -> None:
        """Read an offer."""
        try:
            offer = msgspec.json.decode(message.data, type=Offer)
        except msgspec.MsgspecError:
            return
        search = self._searches.get(offer.search)
        if search is not None and offer.over:
            self._drop(search)
        elif search is not None:
            search.offer, search.heard_s = replace(search.offer, first=offer.first), time.monotonic()
        elif not offer.over and len(self._searches) < MAX_SEARCHES:
            search = _Search(offer, time.monotonic(), self._folder / offer.search)
            self._searches[offer.search] = search
            search.serving = asyncio.create_task(self._serve(search))

    async def _beat(self) -> None:
        """Answer the searches, and drop those that are silent."""
        for search in list(self._searches.values()):
            if self._client.is_connected and time.monotonic() - search.heard_s > OVER_S:
                self._drop(search)
            else:
                await self._answer(search, self._jobs)

    async def _answer(self, search: _Search, jobs: int) -> None:
        presence = Presence(self._id, self._host, os.getpid(), jobs, search.problem)
        with suppress(library("nats.errors", INSTALL).Error, OSError):
            await self._client.publish(workers_of(search.offer.search), msgspec.json.encode(presence))

    def _drop(self, search: _Search) -> None:
        """Stop to serve a search."""
        search.over = True
        del self._searches[search.offer.search]
        work = asyncio.create_task(self._clear(search))
        self._clearing.add(work)
        work.add_done_callback(self._clearing.discard)

    async def _clear(self, search: _Search) -> None:
        """Wait for the end of a search's trials, and remove its processes and files."""
        if search.serving is not None:
            await end(search.serving)
            await asyncio.gather(*search.running, return_exceptions=True)
        for slot in self._all:
            await asyncio.get_running_loop().run_in_executor(slot.thread, slot.forget, search.offer.search)
        await asyncio.to_thread(shutil.rmtree, search.place, ignore_errors=True)
        if not search.problem:
            self._tell(f"the search of {search.offer.campaign} on {search.offer.host} is over: {search.trials} trials")

    async def _serve(self, search: _Search) -> None:
        """Fetch what a search needs, and run its trials."""
        offer, own = search.offer, await asyncio.to_thread(differences, search.offer.environment, search.offer.host)
        if own:
            self._refuse(search, "; ".join(own)[:4000])
            return
        while True:
            try:
                async with asyncio.timeout(FETCH_S):
                    count = await self._fetch(search)
                break
            except (ShmioError, TimeoutError) as error:
                self._refuse(search, str(error) or "its files did not arrive")
                await asyncio.sleep(OVER_S)
        search.problem = ""
        self._tell(f"a search of {offer.campaign} on {offer.host}: {count} files received")
        await self._answer(search, self._jobs)
        try:
            await self._take(search)
        except ShmioError as error:
            self._refuse(search, str(error))

    def _refuse(self, search: _Search, problem: str) -> None:
        if problem != search.problem:
            self._tell(f"the search of {search.offer.campaign} on {search.offer.host} is not served: {problem}")
        search.problem = problem

    async def _fetch(self, search: _Search) -> int:
        """Fetch the bundle, and unpack it."""
        errors, js = library("nats.errors", INSTALL), library("nats.js.errors", INSTALL)
        data = _Bounded()
        try:
            await (await open_store(self._client)).get(search.offer.digest, writeinto=data)  # type: ignore[arg-type]
        except (errors.Error, js.Error, OSError) as error:
            raise RemoteError(f"its files cannot be fetched: {error or type(error).__name__}") from None
        if data.digest != search.offer.digest:
            raise RemoteError("its files are damaged: their digest is wrong")
        for path in (search.offer.config, search.offer.folder):
            place_in(search.place, path)  # checks them
        await asyncio.to_thread(shutil.rmtree, search.place, ignore_errors=True)
        return await asyncio.to_thread(unpack, bytes(data.content), search.place)

    # -- tasks ---------------------------------------------------------------------------------------------------------

    async def _take(self, search: _Search) -> None:
        """Take tasks from the queue as long as there are free slots."""
        errors = library("nats.errors", INSTALL)
        consumer = await self._client.jetstream().pull_subscribe_bind(task_consumer(search.offer.search), NAME)
        slot: _Slot | None = None
        try:
            while not (search.over or self._stop.is_set()):  # a cancellation can be lost
                slot = await self._slots.get()
                try:
                    served = sum(not one.problem for one in self._searches.values())
                    (message,) = await consumer.fetch(1, timeout=POLL_S if served < 2 else MANY_S)
                except TimeoutError:
                    pass
                except (errors.Error, OSError):  # the server is away, or the search is just ending
                    await asyncio.sleep(BEAT_S)
                else:
                    work = asyncio.create_task(self._work(search, slot, message))
                    slot = None
                    search.running.add(work)
                    work.add_done_callback(search.running.discard)
                    continue
                self._slots.put_nowait(slot)
                slot = None
        finally:
            if slot is not None:
                self._slots.put_nowait(slot)

    async def _work(self, search: _Search, slot: _Slot, message: Msg) -> None:
        """Run a task, and send its result."""
        errors = library("nats.errors", INSTALL)
        alive = asyncio.create_task(self._show_life(message))
        try:
            try:
                task = msgspec.json.decode(message.data, type=Task)
            except msgspec.MsgspecError:
                await message.term()
                return
            result: Result | None
            if message.metadata.num_delivered > MAX_DELIVERIES:
                reason = f"the worker that ran it was lost, {MAX_DELIVERIES} times"
                result = Result(task.number, "error", reason=reason)
            else:
                run = asyncio.get_running_loop().run_in_executor
                result = await run(slot.thread, slot.run, search, task, self._stop)
            if result is None and self._stop.is_set():
                await message.nak()
            elif result is None:
                await message.ack()
            else:
                search.trials += 1
                await self._send(search, result)
                await message.ack()
        except (errors.Error, OSError):
            pass  # the server delivers the task again
        except ShmioError as error:
            self._refuse(search, str(error))
        finally:
            alive.cancel()
            self._slots.put_nowait(slot)

    async def _show_life(self, message: Msg) -> None:
        errors = library("nats.errors", INSTALL)
        while True:
            await asyncio.sleep(BEAT_S)
            with suppress(errors.Error, OSError):
                await message.in_progress()

    async def _send(self, search: _Search, result: Result) -> None:
        """Let the server store a result."""
        result = _at_home(result, f"{search.place}/", f"{search.offer.root.rstrip('/')}/")
        data = msgspec.json.encode(result)
        if len(data) > self._client.max_payload:
            reason = f"its result has {len(data)} bytes, but a message of NATS at most {self._client.max_payload}"
            data = msgspec.json.encode(Result(result.number, "error", reason=reason))
        subject = results_of(search.offer.search)

        async def publish(stream: JetStreamContext) -> Any:
            return None if search.over else await stream.publish(subject, data)

        await insist(self._client, publish)

    async def _close(self) -> None:
        """Give the running trials back, and leave."""
        self._stop.set()
        for search in list(self._searches.values()):
            if search.serving is not None:
                await end(search.serving)
                if search.running:
                    await asyncio.wait(search.running, timeout=BEAT_S * 5)
                    await asyncio.gather(*map(end, search.running))
            await self._answer(search, 0)
        await asyncio.gather(*self._clearing, return_exceptions=True)
        for slot in self._all:
            await asyncio.get_running_loop().run_in_executor(slot.thread, slot.close)
            slot.thread.shutdown()
        await self._client.leave(LEAVE_S)


class _Bounded(RawIOBase):
    """Keeps what is written, up to the maximum size of a bundle."""

    def __init__(self) -> None:
        self.content = bytearray()

    def write(self, data: Any, /) -> int:
        """Keep more bytes."""
        self.content += data
        if len(self.content) > MAX_BYTES:
            raise OSError(f"they are larger than {MAX_BYTES >> 20} MB")
        return len(data)

    @property
    def digest(self) -> str:
        """SHA-256 of the content, in hexadecimal digits."""
        return hashlib.sha256(self.content).hexdigest()


def _at_home(result: Result, here: str, there: str) -> Result:
    """Return a result whose texts name the files on the search's host."""
    expectations = [replace(one, reason=one.reason.replace(here, there)) for one in result.expectations]
    return replace(result, reason=result.reason.replace(here, there), expectations=expectations)


@contextmanager
def work_folder() -> Iterator[Path]:
    """Create a private folder for a worker, and remove it at the end. Also remove those of killed workers."""
    base = Path(tempfile.gettempdir())
    for old in base.glob(f"{PREFIX}*"):
        with suppress(OSError):
            if old.stat(follow_symlinks=False).st_uid == os.getuid():
                _remove_unused(old)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))
        lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        fcntl.flock(lock, fcntl.LOCK_EX)
        if folder.exists():
            break
        os.close(lock)  # another worker took it for one of a killed worker
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _remove_unused(folder: Path) -> None:
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)
