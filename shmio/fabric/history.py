"""The history of a cell: the JetStream stream that keeps what its uplink publishes.

:func:`fetch` copies a span of it into a recording, which all tools for recordings can then read.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from shmio.errors import RecordingError, RemoteError
from shmio.fabric.connection import INSTALL, connect
from shmio.fabric.messages import Entry, Header, decode_entries, decode_header
from shmio.fabric.names import CellName, source_of
from shmio.fabric.place import Place
from shmio.fabric.registry import Registry
from shmio.layout.model import Layout
from shmio.libraries import library
from shmio.recording.format.encoding import Gap
from shmio.recording.reading.part import DumpBlock
from shmio.recording.rewriting import new_file
from shmio.recording.writer import Channels, Writer
from shmio.segment import Event, Frame
from shmio.version import __version__

if TYPE_CHECKING:
    from nats.aio.client import Client

MAX_BYTES: Final = 1 << 30
"""Maximum size of the messages in a span: they are sorted in memory."""
_IDLE_S: Final = 5.0
_BATCH: Final = 500
_S: Final = 1_000_000_000

log = logging.getLogger("shmio.fabric")


class _Piece(NamedTuple):
    """A frame, event or gap of a source, with its log time."""

    log_ns: int
    order: int
    source: str
    layout: bytes
    entry: Entry


def fetch(place: Place, file: Path, begin_ns: int | None = None, end_ns: int | None = None) -> int:
    """Write a span of a cell's history to a new recording.

    Args:
        place: The cell.
        file: The recording to write. It must not exist.
        begin_ns: UTC time of the first entry, in ns since 1970; None for the oldest.
        end_ns: UTC time of the last entry; None for the newest.

    Returns:
        The number of frames.

    Raises:
        RecordingError: There is no history in this span, the span is too large, or the file cannot
            be written.
        RemoteError: No server can be reached, or it does not keep the cell's history.

    """
    pieces, layouts, blocks = asyncio.run(_read(place, begin_ns, end_ns))
    if not pieces:
        raise RecordingError(f"{place.cell}: the fabric has no history in that time")
    about = {
        "instance": place.cell.cell,
        "cell": str(place.cell),
        "version": __version__,
        "recorder": "fabric",
        "mode": "live",
    }
    frames = 0
    with new_file(file) as stream:
        writer = Writer(stream, about)
        opened: dict[tuple[str, bytes], Channels] = {}
        for layout in layouts.values():
            writer.attach_layout(layout, pieces[0].log_ns)
        for piece in pieces:
            key = piece.source, piece.layout
            if isinstance(piece.entry, Gap):
                writer.gap(piece.entry, piece.log_ns)
                continue
            if key not in opened:
                block = blocks[key]
                number, event = _before(piece.entry)
                opened[key] = writer.open_block(block, block.section, number, event)
            if isinstance(piece.entry, Frame):
                frames += 1
                writer.frame(opened[key], piece.entry, piece.log_ns)
            else:
                writer.event(opened[key], piece.entry, piece.log_ns)
        writer.finish()
    return frames


def _before(entry: Frame | Event) -> tuple[int, int]:
    """Return the numbers of the frame and of the event before an entry."""
    return (entry.number - 1, entry.event) if isinstance(entry, Frame) else (entry.frame, entry.number - 1)


async def _read(
    place: Place, begin_ns: int | None, end_ns: int | None
) -> tuple[list[_Piece], dict[bytes, Layout], dict[tuple[str, bytes], DumpBlock]]:
    client = await connect(place.access, "shmio history", patient=False)
    try:
        received = [one async for one in _messages(client, place.cell, begin_ns, end_ns)]
        registry = await Registry.open(client)
        seen = await registry.find(place.cell)
        known = {} if seen is None else {source.name: source for source in seen.entry.sources}
        layouts: dict[bytes, Layout] = {}
        blocks: dict[tuple[str, bytes], DumpBlock] = {}
        for source, header, _ in received:
            key = source, header.layout
            if key in blocks:
                continue
            if header.layout not in layouts:
                layouts[header.layout] = await registry.layout_like(header.layout)
            layout, entry = layouts[header.layout], known.get(source)
            period_ns, stale_ns = (20_000_000, 500_000_000) if entry is None else (entry.period_ns, entry.stale_ns)
            blocks[key] = DumpBlock(source, len(blocks) + 1, layout, layout.hash.hex(), period_ns, stale_ns)
    except (TimeoutError, library("nats.errors", INSTALL).Error) as error:
        raise RemoteError(f"{place.access}: {error or 'the server does not answer'}") from None
    finally:
        await client.close()
    pieces = sorted(_pieces(received, begin_ns, end_ns), key=lambda piece: piece[:3])
    return pieces, layouts, blocks


async def _messages(client: Client, cell: CellName, begin_ns: int | None, end_ns: int | None) -> Any:
    """Yield source, header and bytes of each message of a span, in the order in which the server stored them.

    Messages that were published late are stored after the time of their frames, so the stream is
    read to its end.
    """
    errors = library("nats.js.errors", INSTALL)
    nats_errors = library("nats.errors", INSTALL)
    api = library("nats.js.api", INSTALL)
    stream = client.jetstream()
    config: dict[str, Any] = {"deliver_policy": api.DeliverPolicy.ALL}
    if begin_ns is not None:
        start = datetime.fromtimestamp(begin_ns // _S, UTC).isoformat()
        config = {"deliver_policy": api.DeliverPolicy.BY_START_TIME, "opt_start_time": start}
    config |= {"ack_policy": api.AckPolicy.NONE, "inactive_threshold": 60.0}
    try:
        reader = await stream.pull_subscribe(
            f"{cell.subject}.*.*", stream=cell.history, config=api.ConsumerConfig(**config)
        )
    except errors.NotFoundError:
        raise RemoteError(
            f"the fabric keeps no history of {cell}; add [fabric.history] to the configuration of that cell"
        ) from None
    left, size = (await reader.consumer_info()).num_pending, 0
    try:
        while left:
            try:
                batch = await reader.fetch(min(left, _BATCH), timeout=_IDLE_S)
            except nats_errors.TimeoutError:
                return
            for message in batch:
                left -= 1
                try:
                    header = decode_header(message.data)
                except ValueError:
                    continue
                if end_ns is not None and header.made_ns > end_ns + _S:
                    continue
                size += len(message.data)
                if size > MAX_BYTES:
                    raise RecordingError(
                        f"the history of {cell} in that time is larger than 1 GB; choose a shorter time"
                    )
                yield source_of(message.subject.split(".")[4]), header, message.data
    finally:
        await reader.unsubscribe()


def _pieces(received: list[tuple[str, Header, bytes]], begin_ns: int | None, end_ns: int | None) -> Iterator[_Piece]:
    """Yield all entries once, with their log times.

    The log time is the owner's UTC time: the first message of an uplink relates it to the times of
    the entries.
    """
    offsets: dict[tuple[str, int], int] = {}
    seen: set[tuple[str, int, int]] = set()
    for source, header, data in sorted(received, key=lambda one: (one[0], one[1].stream, one[1].number)):
        if (source, header.stream, header.number) in seen:
            continue
        seen.add((source, header.stream, header.number))
        try:
            entries = list(decode_entries(data))
        except ValueError as error:
            log.warning("a message of %s is malformed: %s", source, error)
            continue
        times = [entry.publish_ns for entry in entries if not isinstance(entry, Gap)]
        if not times:
            continue
        offset_ns = offsets.setdefault((source, header.stream), header.made_ns - times[-1])
        at_ns = times[0]
        for order, entry in enumerate(entries):
            at_ns = at_ns if isinstance(entry, Gap) else max(at_ns, entry.publish_ns)
            log_ns = at_ns + offset_ns
            if (begin_ns or 0) <= log_ns and (end_ns is None or log_ns <= end_ns):
                yield _Piece(log_ns, header.number * 65_536 + order, source, header.layout, entry)
