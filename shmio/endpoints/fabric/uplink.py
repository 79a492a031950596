"""The uplink: publishes the sources of the instance, and keeps the cell's entry in the registry."""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
import time
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from shmio.config.masking import mask_line
from shmio.config.model import FabricAllow, FabricHistory, FabricRule
from shmio.endpoints.fabric.backlog import Backlog, Kept, Row
from shmio.endpoints.fabric.commands import CommandReceiver
from shmio.endpoints.fabric.feed import Feed, rule_for
from shmio.endpoints.fabric.history import History
from shmio.endpoints.fabric.publisher import Publisher
from shmio.errors import ConfigError, ConflictError, RemoteError, SegmentError
from shmio.fabric.connection import INSTALL, Access, connect, is_stored, reason, refusal, wants_reply
from shmio.fabric.machine import machine
from shmio.fabric.messages import Header, asks_for_state, encode_state, with_header
from shmio.fabric.names import CellName, source_of
from shmio.fabric.registry import RENEW_S, CellEntry, Registry, SourceEntry
from shmio.libraries import library
from shmio.local.status import problems, status_of
from shmio.recording.format.encoding import BlockPosition
from shmio.segment import Block, ProcessSlot, Segment
from shmio.segment.doorbell import Relay
from shmio.segment.header import State
from shmio.version import __version__

if TYPE_CHECKING:
    from nats.aio.msg import Msg

    from shmio.fabric.client import FabricClient

MIRROR: Final = "fabric"
"""Connector of the sources that are mirrors. They are published only by their owner."""
STOPPED: Final = str(State.STOPPED)
RETRY_S: Final = 1.0
"""Pause in s before another attempt to claim the cell."""
LAYOUTS_S: Final = 10.0
"""Interval in s at which the uplink checks that the registry has its layouts."""
LEAVE_S: Final = 2.0
"""Time limit in s for sending the last messages when the uplink stops."""
MAX_REQUESTS: Final = 1024
"""Maximum number of requests of other cells that wait. Further requests are dropped."""

MAX_NOTE: Final = 500
"""Maximum number of characters of what the cell's entry says about problems."""

log = logging.getLogger("shmio.fabric")


class UplinkSettings(msgspec.Struct, frozen=True):
    """What the uplink's process needs of the configuration.

    Attributes:
        access: The servers.
        cell: Name of the cell.
        backlog_mb: Maximum size of the backlog, in MB.
        rule: What to publish of which source.
        allow: What other cells may do.
        history: The stream in which the servers keep the messages; None: there is none.
        web: Address of the cell's web page; empty if it has none.

    """

    access: Access
    cell: str
    backlog_mb: float
    rule: Sequence[FabricRule] = ()
    allow: Sequence[FabricAllow] = ()
    history: FabricHistory | None = None
    web: str = ""


class Uplink:
    """Publishes a segment. Use it only in the event loop's thread."""

    def __init__(self, segment: Segment, slot: ProcessSlot, settings: UplinkSettings) -> None:
        self.cell = CellName.parse(settings.cell)
        kept = settings.history
        self.backlog = Backlog(round(settings.backlog_mb * 1e6), until_confirmed=kept is not None)
        self._history = None if kept is None else History(self.cell, kept)
        self.publisher = Publisher(self.backlog, self._history)
        self.problem = ""
        """The present problem; empty if there is none."""
        self.tried = asyncio.Event()
        """Set once the uplink publishes, or ``problem`` says why it does not."""
        self.connects = 0
        self._segment, self._settings = segment, settings
        if slot.writer is None:
            raise SegmentError("the segment has no command queue for this process")
        self._writer = slot.writer
        self._feeds: dict[str, Feed] = {}
        self.commands = CommandReceiver(
            self.cell,
            settings.allow,
            slot.writer,
            lambda: self._log_time(time.monotonic_ns()),
            self._reply,
            str(settings.access),
            self._feeds,
        )
        self._replies: set[asyncio.Task[None]] = set()
        self._asking: set[str] = set()
        """The subjects to which answers to requests for missing messages are being sent."""
        self._errors = library("nats.errors", INSTALL)
        stored = library("nats.js.errors", INSTALL)
        self._gone = stored.NoStreamResponseError, stored.NotFoundError
        self._checked_s = 0.0
        self._unspread = ""
        self._generation = -1
        self._first = True
        self._relays: dict[int, Relay] = {}
        self._stopped: list[Relay] = []
        self._reading: asyncio.Task[list[Feed]] | None = None
        self._missed = 0
        self._connected = asyncio.Event()
        self._changed = asyncio.Event()
        self._starting = True
        self._client: FabricClient | None = None
        self._claimed = self._closing = False
        self._revision = 0
        self._known_layouts: set[bytes] = set()

    @property
    def counters(self) -> tuple[int, ...]:
        """The counters, in the order in which the process table names them."""
        publisher = self.publisher
        missed = self._missed + sum(feed.missed for feed in self._feeds.values())
        return (
            publisher.sent, publisher.late, self.backlog.waiting, self.backlog.dropped, missed, self.commands.received,
            self.commands.refused, self.connects,
            publisher.sent_bytes,
        )  # fmt: skip

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that the uplink reads, each with the number of the last frame read."""
        return ((feed.block, feed.last) for feed in self._feeds.values())

    # ---- sources that come and go ------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Follow all sources from now on."""
        self._add(await asyncio.to_thread(self._read_blocks, ()))

    def follow_start(self) -> None:
        """Tell the fabric as soon as the instance has started, and not with the next renewal."""
        starting = self._segment.supervisor[1] is State.STARTING
        if self._starting and not starting:
            self._changed.set()
        self._starting = starting

    def follow_reloads(self) -> None:
        """Add and remove sources after a reload. A thread reads new layouts, because that may take seconds."""
        if self._reading is not None and self._reading.done():
            reading, self._reading = self._reading, None
            self._add(reading.result())
        if self._reading is None and self._segment.generation != self._generation:
            known = {feed.block.section for feed in self._feeds.values()}
            self._reading = asyncio.get_running_loop().create_task(asyncio.to_thread(self._read_blocks, known))
        if self._reading is not None:
            return
        for feed in [feed for feed in self._feeds.values() if feed.ended]:
            source = feed.block.source
            if source not in self._segment.blocks:
                self._stop(feed)
                del self._feeds[source]
                self.backlog.remove(source)
                self._changed.set()
                log.info("a reload removed the source %s", source)

    def _read_blocks(self, known: Container[int]) -> list[Feed]:
        self._generation = self._segment.generation  # first, so that the next check notices a change meanwhile
        self._segment.refresh()
        blocks = self._segment.blocks
        feeds = [
            self._new_feed(block, list(blocks))
            for block in blocks.values()
            if block.section not in known and block.attributes.connector != MIRROR
            if rule_for(self._settings.rule, block.source).send != "nothing"
        ]
        return [feed for feed in feeds if not feed.empty]

    def _new_feed(self, block: Block, sources: Sequence[str]) -> Feed:
        # A block of a reload is published from its first frame on.
        place = BlockPosition(block.ring.head(), block.events.head()) if self._first else BlockPosition()
        rule = rule_for(self._settings.rule, block.source)
        return Feed(block, rule, sources, self._segment.header.started_utc_ns, place, self._writer)

    def _add(self, feeds: list[Feed]) -> None:
        self._first = False
        loop = asyncio.get_running_loop()
        for feed in feeds:
            source = feed.block.source
            if (before := self._feeds.get(source)) is not None:
                while self._poll(before):
                    pass
                self._stop(before)
            else:
                self.backlog.rows[source] = Row(self.cell, source, secrets.randbits(63) | 1)
            self._feeds[source] = feed
            relay = Relay(feed.block.ring, f"bell-{source}", feed.turn_ns)
            self._relays[feed.block.section] = relay
            loop.add_reader(relay.descriptor, partial(self._wake, feed, relay))
        if feeds:
            self._changed.set()

    def _stop(self, feed: Feed) -> None:
        self._missed += feed.missed
        self.commands.remove(feed.block)
        relay = self._relays.pop(feed.block.section)
        asyncio.get_running_loop().remove_reader(relay.descriptor)
        relay.stop()
        self._stopped = [one for one in self._stopped if one.alive] + [relay]

    # ---- new entries -------------------------------------------------------------------------------------------------

    def _log_time(self, monotonic_ns: int) -> int:
        """Convert CLOCK_MONOTONIC to UTC, as the start of the instance had it: changes of the clock have no effect."""
        head = self._segment.header
        return head.started_utc_ns + monotonic_ns - head.started_ns

    def _wake(self, feed: Feed, relay: Relay) -> None:
        relay.acknowledge()
        self._poll_on(feed)

    def _poll_on(self, feed: Feed) -> None:
        if self._feeds.get(feed.block.source) is feed and self._poll(feed):
            asyncio.get_running_loop().call_soon(self._poll_on, feed)

    def _poll(self, feed: Feed) -> bool:
        """Put new entries into the backlog, and return whether more are waiting."""
        client = self.commands.client(feed)
        client.poll()
        batches, more = feed.read()
        row = self.backlog.rows[feed.block.source]
        if (state := client.state.read()) is not None:
            self._put(feed, row, partial(encode_state, state=state))
        for batch in batches:
            row.left_out += batch.left_out
            self._put(feed, row, partial(with_header, entries=batch.entries))
        if batches or state is not None:
            self.publisher.wake()
        return more

    def _put(self, feed: Feed, row: Row, encoded: Callable[[Header], bytearray]) -> None:
        """Put a message into the backlog."""
        now_ns = time.monotonic_ns()
        number = row.last + 1
        times = self._log_time(now_ns), 0, self._log_time(0)
        header = Header(row.left_out, row.stream, number, feed.digest[:8], *times)
        self.backlog.put(row, Kept(number, encoded(header), now_ns))

    # ---- the connection ----------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Keep the connection and the cell's entry, until the task is cancelled.

        Raises:
            ConfigError: Another living cell has this name, or a file cannot be used.

        """
        self.problem = f"{self._settings.access}: no NATS server has answered yet"
        self._client = await connect(
            self._settings.access,
            f"shmio {self.cell}",
            lost=self._on_lost,
            back=self._on_connected,
            failed=self._on_failed,
        )
        await self._client.subscribe(self.cell.missing("*"), cb=self._on_missing, pending_msgs_limit=MAX_REQUESTS)
        await self._client.subscribe(self.cell.command_subjects, cb=self._on_command, pending_msgs_limit=MAX_REQUESTS)
        await self._on_connected()
        while True:
            await self._connected.wait()
            if await self._establish(self._client):
                await self._stay(self._client)
            else:
                await asyncio.sleep(RETRY_S)

    async def _on_connected(self) -> None:
        self.connects += 1
        log.info("connected to %s", self._settings.access)
        self._connected.set()

    async def _on_lost(self) -> None:
        self._connected.clear()
        self._changed.set()
        self.publisher.end()
        if self._closing:
            return
        self.problem = f"{self._settings.access}: the connection is lost; the backlog keeps new messages"
        log.warning("%s", self.problem)

    def _on_failed(self, why: str) -> None:
        self.problem = f"{why}; the backlog keeps new messages"
        self.tried.set()

    async def _establish(self, client: FabricClient) -> bool:
        """Claim the cell, then publish. Return False if the registry does not answer."""
        try:
            await self._open_registry(client)
        except ConflictError as error:
            raise ConfigError(str(error)) from None
        except (RemoteError, self._errors.Error, TimeoutError) as error:
            self._complain(error)
            self.tried.set()
            if not self._claimed:
                return False
        else:
            self.problem = ""
            self.tried.set()
        if self._history is not None:
            with suppress(self._errors.Error):  # the connection is lost again
                await self._history.begin(client)
        if self._connected.is_set():
            self.publisher.begin(client)
        return True

    async def _open_registry(self, client: FabricClient) -> None:
        """Open the registry, and put the layouts and the cell's entry into it. If it is missing, create it."""
        client.refused = ""
        kept = self._settings.history
        self._registry = await Registry.open(client, replicas=1 if kept is None else kept.replicas)
        self._known_layouts.clear()
        self._checked_s = time.monotonic()
        await self._renew(self._registry)

    async def _stay(self, client: FabricClient) -> None:
        """Renew the cell's entry until the connection is lost."""
        await self._spread_registry()
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(RENEW_S):
                    await self._changed.wait()
            self._changed.clear()
            if not self.publisher.up:
                return
            try:
                try:
                    await self._check_layouts()
                    await self._renew(self._registry)
                except self._gone:
                    await self._open_registry(client)
                    log.warning("the registry was gone; this cell is in a new one")
            except ConflictError as error:
                raise ConfigError(str(error)) from None
            except (RemoteError, self._errors.Error, TimeoutError) as error:
                if self.publisher.up:
                    self._complain(error)
            else:
                self.problem = "" if self._history is None else self._history.problem
            if self._history is not None and self.publisher.up:
                with suppress(self._errors.Error):
                    await self._history.check()

    async def _spread_registry(self) -> None:
        """Let as many servers keep the registry as keep the history."""
        kept = self._settings.history
        if kept is None or kept.replicas == 1 or not self._claimed:
            return
        try:
            await self._registry.spread(kept.replicas)
        except (RemoteError, TimeoutError) as error:
            if str(error) != self._unspread:
                remedy = f"run shmio fabric prepare --replicas {kept.replicas} with the administrator's seed"
                log.warning("%s; %s", error, remedy)
            self._unspread = str(error)

    async def _check_layouts(self) -> None:
        """Notice layouts that the registry has lost: the entry alone would not show it."""
        if time.monotonic() - self._checked_s >= LAYOUTS_S:
            self._checked_s = time.monotonic()
            self._known_layouts.difference_update(await self._registry.missing_layouts(list(self._known_layouts)))

    def _complain(self, error: Exception) -> None:
        why = str(error)
        if not isinstance(error, RemoteError):  # its text says what to do
            refused = "" if self._client is None else self._client.refused
            why = refusal(self._settings.access, refused, self.cell) or f"the registry does not answer: {reason(error)}"
        problem = f"{self._settings.access}: {why}"
        if problem != self.problem:
            self.problem = problem
            log.warning("%s", problem)

    async def _renew(self, registry: Registry) -> None:
        """Store the layouts and the cell's entry, and publish the entry."""
        if self._client is not None:
            self._client.refused = ""
        for feed in tuple(self._feeds.values()):
            if feed.digest not in self._known_layouts:
                await registry.put_layout(feed.layout)
                self._known_layouts.add(feed.digest)
        entry = self._entry()
        if self._claimed:
            self._revision = await registry.renew(entry, self._revision)
        else:
            self._revision = await registry.claim(entry)
            self._claimed = True
            log.info("this instance is the cell %s of the fabric", self.cell)
        if self._client is not None:
            await self._client.publish(self.cell.status, msgspec.json.encode(entry))

    def _entry(self, *, stopped: bool = False) -> CellEntry:
        head = self._segment.header
        status = status_of(self._segment, "", "fabric")
        state = str(status.state)
        if stopped or state == STOPPED:  # a cell that publishes is not stopped, whatever has become of its supervisor
            state = STOPPED if stopped else str(State.DEGRADED)
        return CellEntry(
            str(self.cell), socket.gethostname(), self._segment.instance, __version__, f"{head.epoch:016x}", state,
            head.started_utc_ns, self._log_time(time.monotonic_ns()), self._settings.web,
            tuple(self._source_entry(feed) for feed in self._feeds.values()),
            "" if stopped else mask_line("; ".join(problems(status)))[:MAX_NOTE], machine(),
        )  # fmt: skip

    def _source_entry(self, feed: Feed) -> SourceEntry:
        block = feed.block
        frame = block.latest()
        quality, reason = ("bad", "no frame yet") if frame is None else map(str, block.assess(frame))
        row = self.backlog.rows[block.source]
        return SourceEntry(
            block.source, feed.digest.hex(), block.period_ns, block.stale_ns, row.stream, quality, reason,
            len(feed.layout.registers), row.last,
        )  # fmt: skip

    # ---- requests ----------------------------------------------------------------------------------------------------

    async def _on_missing(self, message: Msg) -> None:
        source = source_of(message.subject.split(".")[4])
        reply = message.reply
        if reply not in self._asking and len(self._asking) < MAX_REQUESTS:  # each reader waits for an answer's end
            self._asking.add(reply)
            answer = asyncio.get_running_loop().create_task(
                self.publisher.answer(self.backlog.rows.get(source), message)
            )
            self._replies.add(answer)
            answer.add_done_callback(partial(self._answered, reply))
        if (feed := self._feeds.get(source)) is None or not asks_for_state(message.data):
            return
        state = self.commands.client(feed).state
        if not state.wanted:
            state.wanted = True
            self._poll_on(feed)

    def _answered(self, reply: str, answer: asyncio.Task[None]) -> None:
        self._replies.discard(answer)
        self._asking.discard(reply)

    async def _on_command(self, message: Msg) -> None:
        if is_stored(message):
            return
        # Another instance may own the name of this cell: only its owner carries out commands, and answers.
        await self.publisher.begun.wait()
        tokens = message.subject.split(".")
        source, sender = source_of(tokens[4]), ".".join(tokens[6:])
        reply = message.reply if wants_reply(message) else ""
        row = self.backlog.rows.get(source)
        stream = 0 if row is None else row.stream
        self.commands.take(sender, source, stream, message.data, reply)

    def _reply(self, subject: str, data: bytes) -> None:
        """Send a reply, unless the connection is lost: then the sender does not learn the outcome."""
        task = asyncio.get_running_loop().create_task(self._send_reply(subject, data))
        self._replies.add(task)
        task.add_done_callback(self._replies.discard)

    async def _send_reply(self, subject: str, data: bytes) -> None:
        if self._client is not None:
            with suppress(self._errors.Error):
                await self._client.publish(subject, data)

    # ---- the end -----------------------------------------------------------------------------------------------------

    async def close(self) -> None:
        """Send the last messages, and mark the cell as stopped."""
        self._closing = True
        for feed in tuple(self._feeds.values()):
            while self._poll(feed):
                pass
            self._stop(feed)
        if self._replies:
            _, waiting = await asyncio.wait(self._replies, timeout=LEAVE_S)
            for task in waiting:  # the server does not take them
                task.cancel()
        await self.publisher.finish(LEAVE_S)
        client = self._client
        if client is not None and self._connected.is_set():
            with suppress(RemoteError, ConflictError, self._errors.Error, TimeoutError):
                async with asyncio.timeout(LEAVE_S):
                    if self._claimed:
                        entry = self._entry(stopped=True)
                        await self._registry.renew(entry, self._revision)
                        await client.publish(self.cell.status, msgspec.json.encode(entry))
        self.publisher.end()
        if client is not None:
            await client.leave(LEAVE_S)
        if self._reading is not None:
            await asyncio.wait((self._reading,))
        for relay in self._stopped:
            relay.join()
