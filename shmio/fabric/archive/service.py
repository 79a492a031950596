"""Reads the histories of all cells, and passes them on to the files.

The state files say where to go on, and not the server: the files and a server's acknowledgements
cannot change at the same moment. The acknowledgements only show in the server's statistics how far
the archive is.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from shmio.errors import RemoteError
from shmio.fabric.archive.cell_files import CellFiles, ClosedFile
from shmio.fabric.archive.folder import ArchiveFolder
from shmio.fabric.connection import INSTALL, Access, connect_or_stop, reason, refusal
from shmio.fabric.messages import decode_header
from shmio.fabric.names import ROOT, CellName, source_of
from shmio.fabric.registry import Registry
from shmio.layout.model import Layout
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.msg import Msg

    from shmio.fabric.client import FabricClient

MEMORY_BYTES: Final = 256 << 20
"""Rows of all cells in memory. Beyond it, the cell with the most writes its rows to its files."""
MAX_MESSAGES: Final = 500_000
"""Number of messages of a cell after which its files are closed."""
SCAN_S: Final = 5.0
"""Interval at which the archive looks for new cells, in s."""
_BATCH: Final = 128
_PAUSE_S: Final = 0.5
"""Pause before another request to a stream that had no more messages, in s."""
_WAIT_S: Final = 1.0
_RETRY_S: Final = 1.0
_LEAVE_S: Final = 5.0
"""Maximum time until the server has taken the last acknowledgements, in s."""
_ANY_TIME: Final = datetime.fromtimestamp(0, UTC)
_LAYOUT_S: Final = 60.0
"""Longest wait for the registry to have the layout of a message, in s."""

log = logging.getLogger("shmio.fabric")

T = TypeVar("T")


class ArchiveLimits(msgspec.Struct, frozen=True):
    """When the files of a cell are closed: if one of them has this size, or when they have this age."""

    max_bytes: int = 128_000_000
    max_age_s: float = 600.0


class _ConsumerLostError(Exception):
    """Messages are missing between the server and this process: the consumer has to begin again."""


class Archive:
    """Archives the cells whose names match a pattern. Use it in one event loop."""

    def __init__(
        self,
        access: Access,
        folder: ArchiveFolder,
        patterns: Sequence[str],
        limits: ArchiveLimits,
        closed: Callable[[ClosedFile], None],
        stopping: asyncio.Event,
    ) -> None:
        """Create the archive.

        Args:
            access: The servers.
            folder: The folder of the archive, which this process has locked.
            patterns: Globs for the names of cells.
            limits: When files are closed.
            closed: Called for each file that is complete.
            stopping: When it is set, :meth:`run` closes all files and returns.

        """
        self._access = access
        self._folder = folder
        self._patterns = patterns
        self._limits = limits
        self._closed = closed
        self._stopping = stopping
        self._files: dict[CellName, CellFiles] = {}
        self._layouts: dict[bytes, Layout] = {}
        self._unknown: set[bytes] = set()
        self._worker = ThreadPoolExecutor(1, "archive")  # one thread, so that files need no lock
        self._errors = library("nats.errors", INSTALL)
        self._stream_errors = library("nats.js.errors", INSTALL)
        self._api = library("nats.js.api", INSTALL)

    async def run(self) -> None:
        """Archive until ``stopping`` is set.

        Raises:
            ConfigError: A file with credentials or certificates cannot be used.
            OSError: A file cannot be written.
            RecordingError: The state of a cell is damaged.
            RemoteError: The server has no JetStream.

        """
        client = await connect_or_stop(self._access, "shmio archive", self._stopping)
        if client is None:
            return
        try:
            async with asyncio.TaskGroup() as tasks:
                await self._or_stop(self._find_cells(client, tasks))
        except BaseExceptionGroup as group:
            raise group.exceptions[0] from None
        finally:
            for files in self._files.values():
                await self._work(files.discard)
            self._worker.shutdown()
            await client.leave(_LEAVE_S)

    async def _or_stop(self, part: Coroutine[Any, Any, None]) -> None:
        """Do a part of the work. If it fails, stop the others: the group's cancellation can be lost in a request."""
        try:
            await part
        except BaseException:
            self._stopping.set()
            raise

    async def _work(self, task: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._worker, task)

    async def _pause(self, pause_s: float) -> None:
        with suppress(TimeoutError):
            await asyncio.wait_for(self._stopping.wait(), pause_s)

    # ---- cells -------------------------------------------------------------------------------------------------------

    async def _find_cells(self, client: FabricClient, tasks: asyncio.TaskGroup) -> None:
        running: dict[CellName, asyncio.Task[None]] = {}
        problem = ""
        while not self._stopping.is_set():
            try:
                for cell in await self._cells(client):
                    if cell not in running or running[cell].done():
                        running[cell] = tasks.create_task(self._or_stop(self._follow(client, cell)))
                problem = ""
            except self._errors.NoRespondersError:
                raise RemoteError(f"{self._access}: the NATS server has no JetStream, and so no histories") from None
            except (self._errors.Error, TimeoutError) as error:
                why = refusal(self._access, client.refused) or reason(error)
                if client.is_connected and problem != why:
                    problem = why
                    log.warning("%s: the server does not list its streams: %s", self._access, why)
            await self._pause(SCAN_S)

    async def _cells(self, client: FabricClient) -> list[CellName]:
        """Return the cells that have a history and match a pattern."""
        found: list[CellName] = []
        offset = 0
        while True:
            request = msgspec.json.encode({"subject": f"{ROOT}.>", "offset": offset})
            answer = await client.request("$JS.API.STREAM.NAMES", request, timeout=5.0)
            page = msgspec.json.decode(answer.data, type=_StreamNames)
            names = page.streams or []
            found += [cell for cell in map(CellName.of_history, names) if cell is not None]
            offset += len(names)
            if not names or offset >= page.total:
                break
        return [cell for cell in found if any(fnmatchcase(str(cell), pattern) for pattern in self._patterns)]

    async def _follow(self, client: FabricClient, cell: CellName) -> None:
        """Archive one cell until the archive is stopped, or the stream of the cell is deleted."""
        if cell not in self._files:
            self._files[cell] = await self._work(partial(CellFiles, self._folder.path, cell))
            log.info("%s: archiving", cell)
        files = self._files[cell]
        reader = _CellReader(self, client, cell, files)
        while not self._stopping.is_set():
            try:
                await reader.read()
            except self._stream_errors.NotFoundError:
                if not await self._exists(client, cell):
                    break
            except (_ConsumerLostError, self._errors.Error, TimeoutError) as error:
                log.debug("%s: reading begins again: %r", cell, error)
            await reader.commit_if_due()
            await self._pause(_RETRY_S)
        await reader.commit()

    async def _exists(self, client: FabricClient, cell: CellName) -> bool:
        try:
            await client.jetstream().stream_info(cell.history)
        except self._stream_errors.NotFoundError:
            return False
        except (self._errors.Error, TimeoutError):
            return True
        return True

    # ---- layouts and memory ------------------------------------------------------------------------------------------

    async def _layout(self, client: FabricClient, cell: CellName, head: bytes) -> Layout | None:
        """Return a layout; None if the registry does not have it. A cell stores it soon after its first frames."""
        if head in self._layouts:
            return self._layouts[head]
        until_s = time.monotonic() + (0 if head in self._unknown else _LAYOUT_S)
        while True:
            try:
                layout = await (await Registry.open(client)).layout_like(head)
            except RemoteError as error:
                if time.monotonic() >= until_s:
                    if head not in self._unknown:
                        self._unknown.add(head)
                        log.error("%s: frames of a layout are left out: %s", cell, error)
                    return None
                await self._pause(_RETRY_S)
                if self._stopping.is_set():
                    raise _ConsumerLostError from None
            else:
                self._layouts[head] = layout
                return layout

    def _spare_memory(self) -> None:
        while sum(files.memory for files in self._files.values()) > MEMORY_BYTES:
            max(self._files.values(), key=lambda files: files.memory).flush()


class _StreamNames(msgspec.Struct):
    total: int = 0
    streams: list[str] | None = None


class _CellReader:
    """Reads the stream of one cell."""

    def __init__(self, archive: Archive, client: FabricClient, cell: CellName, files: CellFiles) -> None:
        self._archive = archive
        self._client = client
        self._cell = cell
        self._files = files
        self._newest: Msg | None = None
        self._begun_s = time.monotonic()

    async def read(self) -> None:
        """Read from the message after the last one on.

        Returns when the archive stops. Raises an error if the connection or the consumer is lost.
        """
        archive = self._archive
        consumer = await self._consumer()
        count = 0
        while not archive._stopping.is_set():
            try:
                batch = await consumer.fetch(_BATCH, timeout=_WAIT_S)
            except archive._errors.TimeoutError:
                batch = []
                if not self._client.is_connected:
                    raise _ConsumerLostError from None
            for message in batch:
                count += 1
                if message.metadata.sequence.consumer != count:
                    raise _ConsumerLostError  # what is between was lost on its way
            if batch:
                await self._add(batch)
            await self.commit_if_due()
            if len(batch) < _BATCH:
                await archive._pause(_PAUSE_S)

    async def _consumer(self) -> Any:
        """Create the durable consumer anew, so that it begins after the last message."""
        archive, stream = self._archive, self._client.jetstream()
        name = self._cell.history
        info = await stream.stream_info(name)
        await archive._work(partial(self._files.begin, info.created or _ANY_TIME, info.state.last_seq))
        first = self._files.received + 1
        if info.state.first_seq > first and self._files.received:
            log.warning(
                "%s: the server has deleted %d messages before they were archived; raise its limits in fabric.history",
                self._cell, info.state.first_seq - first,
            )  # fmt: skip
        durable = f"archive-{archive._folder.identity}"
        with suppress(archive._stream_errors.NotFoundError):
            await stream.delete_consumer(name, durable)
        config = archive._api.ConsumerConfig(
            name=durable,
            durable_name=durable,
            deliver_policy=archive._api.DeliverPolicy.BY_START_SEQUENCE,
            opt_start_seq=first,
            ack_policy=archive._api.AckPolicy.ALL,
            ack_wait=2 * archive._limits.max_age_s + 60,
            max_ack_pending=2 * MAX_MESSAGES,
        )
        await stream.add_consumer(name, config)
        self._newest = None  # an earlier consumer's messages cannot be acknowledged
        return await stream.pull_subscribe_bind(durable, name)

    async def _add(self, batch: list[Msg]) -> None:
        archive, work = self._archive, list[Callable[[], None]]()
        for message in batch:
            sequence = message.metadata.sequence.stream
            if sequence <= self._files.received:
                continue
            layout = None
            try:
                header = decode_header(message.data)
            except ValueError as error:
                log.warning("%s: message %d is left out: %s", self._cell, sequence, error)
            else:
                layout = await archive._layout(self._client, self._cell, header.layout)
            if layout is None:
                work.append(partial(self._files.skip, sequence))
            else:
                source = source_of(message.subject.split(".")[4])
                work.append(partial(self._files.add, sequence, source, header, layout, message.data))

        def add() -> None:
            for one in work:
                one()
            archive._spare_memory()

        if not self._files.messages:
            self._begun_s = time.monotonic()
        await archive._work(add)
        self._newest = batch[-1]

    async def commit_if_due(self) -> None:
        """Close the files if they are large or old enough."""
        files, limits = self._files, self._archive._limits
        if not files.messages:
            return
        old = time.monotonic() - self._begun_s >= limits.max_age_s
        if old or files.full or files.messages >= MAX_MESSAGES or files.largest >= limits.max_bytes:
            await self.commit()

    async def commit(self) -> None:
        """Close the files, and tell the server how far the archive is."""
        for file in await self._archive._work(self._files.commit):
            self._archive._closed(file)
        message, self._newest = self._newest, None
        if message is not None:
            with suppress(self._archive._errors.Error):
                await message.ack()
