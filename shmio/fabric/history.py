"""The history of a cell: the JetStream stream that keeps what its uplink publishes.

:func:`fetch` copies a span of it into a recording, which all tools for recordings can then read.
"""

from __future__ import annotations

import asyncio
import heapq
import logging
import os
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from shmio.errors import RecordingError, RemoteError
from shmio.fabric.connection import INSTALL, call_once
from shmio.fabric.entries import SourceEntries, log_time
from shmio.fabric.messages import Header, decode_entries, decode_header
from shmio.fabric.names import CellName, source_of
from shmio.fabric.place import Place
from shmio.fabric.registry import CellEntry, Registry
from shmio.layout.model import Layout
from shmio.libraries import library
from shmio.recording.format.encoding import Gap
from shmio.recording.reading.part import MAX_NS, Entry
from shmio.recording.reading.reader import Item
from shmio.recording.rewriting import Rewriter, new_file
from shmio.segment import Event, Frame
from shmio.version import __version__

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

_IDLE_S: Final = 5.0
_BATCH: Final = 64
"""Number of messages that are asked for at once. They may have 1 MB each."""
_MARGIN_NS: Final = 5_000_000_000
"""A live message is stored at most this long after others, in ns."""

log = logging.getLogger("shmio.fabric")


def fetch(place: Place, file: Path, begin_ns: int | None = None, end_ns: int | None = None) -> int:
    """Write a span of a cell's history to a new recording.

    The messages are sorted in a temporary file beside the recording, so the span may be larger than
    the memory.

    Args:
        place: The cell.
        file: The recording to write. It must not exist.
        begin_ns: UTC time of the first entry, in ns since 1970; None for the oldest.
        end_ns: UTC time of the last entry; None for the newest.

    Returns:
        The number of frames.

    Raises:
        RecordingError: There is no history in this span, or the file exists already.
        RemoteError: No server can be reached, or it does not keep the cell's history.
        OSError: The file cannot be written.

    """
    begin, end = begin_ns or 0, MAX_NS if end_ns is None else end_ns
    with new_file(file) as stream, _Spool(file.parent) as spool:
        reading = partial(_read, place=place, spool=spool, begin_ns=begin, end_ns=end)
        layouts, seen = asyncio.run(call_once(place.access, reading, "shmio history"))
        known = {} if seen is None else {source.name: source for source in seen.sources}
        numbers = count(1)
        sources = [SourceEntries(source, layouts, known.get(source), numbers) for source in spool.sources]
        spans = [_span(source, spool, begin, end) for source in sources]
        entries = heapq.merge(*spans, key=lambda entry: entry.time_ns)
        first = next(entries, None)
        if first is None:
            raise RecordingError(f"{place.cell}: the fabric has no history in that time")
        work = Rewriter(stream, _about(place.cell, first, seen), whole=True)
        for entry in chain((first,), entries):
            work.add(entry)
        work.finish()
    return work.counts["frames"]


def _about(cell: CellName, first: Entry[Item], seen: CellEntry | None) -> dict[str, str]:
    """Return the metadata of the recording. ``seen`` is what the registry says of the cell now."""
    started_ns = first.time_ns - first.item.clock_ns if isinstance(first.item, Frame | Event) else first.time_ns
    return {
        "instance": cell.cell if seen is None else seen.instance,
        "host": "an unknown host" if seen is None else seen.host,
        "cell": str(cell),
        "mode": "live",
        "started_utc_ns": str(max(0, started_ns)),
        "version": __version__,
        "recorder": "fabric",
        "recording_utc_ns": str(time.time_ns()),
        "recording_ns": str(first.time_ns),
    }


class _Position(NamedTuple):
    """Where a message is in the spool, and when it was made."""

    at: int
    size: int
    made_ns: int


class _Spool:
    """The messages of a span, in a temporary file; only their positions are in memory."""

    def __init__(self, folder: Path) -> None:
        try:
            self._file = TemporaryFile(dir=folder)  # noqa: SIM115  closed by __exit__
        except OSError as error:
            error.filename = str(folder)
            raise
        self._end = 0
        self._positions: dict[str, dict[int, dict[int, _Position]]] = {}

    def add(self, source: str, header: Header, data: bytes) -> None:
        """Store a message, unless it is stored already."""
        numbers = self._positions.setdefault(source, {}).setdefault(header.stream, {})
        if header.number not in numbers:
            self._file.write(data)
            numbers[header.number] = _Position(self._end, len(data), header.made_ns)
            self._end += len(data)

    @property
    def sources(self) -> list[str]:
        """The names of the sources."""
        return sorted(self._positions)

    def messages(self, source: str) -> Iterator[bytes]:
        """Yield the messages of a source in the order in which its uplink made them."""
        self._file.flush()
        for numbers in sorted(self._positions[source].values(), key=lambda numbers: numbers[min(numbers)].made_ns):
            for number in sorted(numbers):
                position = numbers[number]
                yield os.pread(self._file.fileno(), position.size, position.at)

    def __enter__(self) -> _Spool:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _span(entries: SourceEntries, spool: _Spool, begin_ns: int, end_ns: int) -> Iterator[Entry[Item]]:
    for data in spool.messages(entries.source):
        for entry in entries.of(data):
            if begin_ns <= entry.time_ns <= end_ns:
                yield entry


async def _read(
    client: Client, place: Place, spool: _Spool, begin_ns: int, end_ns: int
) -> tuple[dict[bytes, Layout], CellEntry | None]:
    """Fill the spool; return the layouts of its messages, and what the registry says of the cell."""
    heads: set[bytes] = set()
    malformed = 0
    async for message in _messages(client, place.cell, begin_ns, end_ns):
        try:
            header = decode_header(message.data)
        except ValueError:
            malformed += 1
            continue
        heads.add(header.layout)
        spool.add(source_of(message.subject.split(".")[4]), header, message.data)
    registry = await Registry.open(client)
    layouts = {head: await registry.layout_like(head) for head in heads}
    seen = await registry.find(place.cell)
    if malformed:
        log.warning("%s: %d messages of the history are malformed and left out", place.cell, malformed)
    return layouts, None if seen is None else seen.entry


async def _messages(client: Client, cell: CellName, begin_ns: int, end_ns: int) -> AsyncIterator[Msg]:
    """Yield the messages of a span: first the live ones, then the late ones.

    The server's clock and the owner's may differ. The owner's times of live messages increase, so
    the span is found by them. An uplink that could not run for a while makes messages long after
    their entries. Late messages are stored at any time after the time of their entries.
    """
    errors = library("nats.js.errors", INSTALL)
    nats_errors = library("nats.errors", INSTALL)
    stream = client.jetstream()
    try:
        state = (await stream.stream_info(cell.history)).state
    except errors.NotFoundError:
        raise RemoteError(
            f"the fabric keeps no history of {cell}; add [fabric.history] to the configuration of that cell"
        ) from None
    except (errors.ServiceUnavailableError, nats_errors.NoRespondersError):
        raise RemoteError("the NATS server has no JetStream, and so no history; start it with -js") from None
    if not state.messages:
        return
    first, last = max(1, state.first_seq), state.last_seq
    if begin_ns > _MARGIN_NS:
        first = await _find(stream, cell, lambda data: max(_times(data)) >= begin_ns - _MARGIN_NS, first, last + 1)
    after = last + 1
    if end_ns < MAX_NS - _MARGIN_NS:
        after = await _find(stream, cell, lambda data: min(_times(data)) > end_ns + _MARGIN_NS, first, after)
    for subject, end in ((cell.live("*"), after), (cell.late("*"), last + 1)):
        async for message in _range(stream, cell, subject, first, end):
            yield message


def _times(data: bytes) -> list[int]:
    """Return when a message was made, and the times of its frames and events.

    Raises:
        ValueError: The message is malformed, or has neither frames nor events.

    """
    header = decode_header(data)
    times_ns = [log_time(header, entry) for entry in decode_entries(data) if not isinstance(entry, Gap)]
    if not times_ns:
        raise ValueError("the message has neither frames nor events")
    return [header.made_ns, *times_ns]


async def _find(stream: Any, cell: CellName, matches: Callable[[bytes], bool], first: int, end: int) -> int:
    """Return the number of the first live message that matches; ``end`` if there is none.

    All messages after one that matches must match, too. Messages for which ``matches`` raises a
    ValueError do not count.
    """
    errors = library("nats.js.errors", INSTALL)
    low, high = first, end
    while low < high:
        middle = at = (low + high) // 2
        found: bool | None = None
        while found is None and at < high:
            try:
                message = await stream.get_msg(cell.history, seq=at, subject=cell.live("*"), next=True)
            except errors.NotFoundError:
                break
            at = message.seq + 1
            with suppress(ValueError):  # if it does not count, the next one decides
                found = matches(message.data or b"")
        if found is False:
            low = at
        else:
            high = middle
    return low


async def _range(stream: Any, cell: CellName, subject: str, first: int, end: int) -> AsyncIterator[Msg]:
    """Yield the messages of a subject from one sequence number to the one before another.

    Raises:
        RemoteError: The connection was lost, so messages are missing.

    """
    nats_errors = library("nats.errors", INSTALL)
    api = library("nats.js.api", INSTALL)
    if first >= end:
        return
    config = api.ConsumerConfig(
        deliver_policy=api.DeliverPolicy.BY_START_SEQUENCE,
        opt_start_seq=first,
        ack_policy=api.AckPolicy.NONE,
        inactive_threshold=60.0,
    )
    reader = await stream.pull_subscribe(subject, stream=cell.history, config=config)
    left, received = (await reader.consumer_info()).num_pending, 0
    try:
        while left:
            try:
                batch = await reader.fetch(min(left, _BATCH), timeout=_IDLE_S)
            except nats_errors.TimeoutError:
                info = await reader.consumer_info()
                if info.num_pending or info.delivered.consumer_seq != received:
                    raise RemoteError(f"the server has stopped sending the history of {cell}; try again") from None
                return  # its limits removed the rest meanwhile
            for message in batch:
                place = message.metadata.sequence
                received += 1
                if place.consumer != received:
                    raise RemoteError(f"the connection was lost while reading the history of {cell}; try again")
                if place.stream >= end:
                    return
                left = message.metadata.num_pending
                yield message
    finally:
        await reader.unsubscribe()
