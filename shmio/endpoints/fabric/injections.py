"""Injections that other cells have created on a source: who holds them, and the state that is published of all."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import msgspec

from shmio.config import Declaration
from shmio.config.declaration import check_declarations
from shmio.endpoints.fabric.feed import Feed
from shmio.errors import ConfigError, PathError
from shmio.fabric.messages import SourceState
from shmio.injection import compile_program
from shmio.injection.language import Reference, nodes, parse_condition
from shmio.layout.topic import find, parse_topic
from shmio.layout.values.write import Write, paths_of
from shmio.segment import Block
from shmio.segment.injection_list import InjectionEntry

LEASE_S: Final = 5.0
"""Time in s without a renewal after which an injection of another cell is lifted."""
CHECK_S: Final = 0.4
"""Interval in s for checking the leases."""
MAX_TARGETS: Final = 64
"""Maximum number of registers that an incomplete declaration names."""
ASKED_S: Final = 1.0
"""Minimum interval in s between two states that mirrors have asked for: each goes to all mirrors."""

decode_declaration: Final = msgspec.json.Decoder(Declaration).decode  # created before there are threads


@dataclass
class Lease:
    """An injection that another cell has created.

    Attributes:
        sender: The cell; empty if it is not known until the first renewal.
        keep: True if the injection needs no renewals.
        renewed_s: Time of the last renewal, in s of the monotonic clock.
        open: True while the outcome of the command that creates or lifts the injection is not known.

    """

    sender: str
    keep: bool
    renewed_s: float = field(default_factory=time.monotonic)
    open: bool = True


class Leases:
    """The injections that other cells have created on one source, by number.

    Its source lifts them if this process ends, except those with ``keep``. While the process runs, it
    must lift those that their cells no longer renew, because a cell or the connection to it is down. An
    injection in the source's list that has no lease, for example after a snapshot was restored, gets
    one that begins when it is found.
    """

    def __init__(self, block: Block, writer: int) -> None:
        """Create the leases of a source; ``writer`` is the number of this process's command queue."""
        self._block, self._writer = block, writer
        self._leases: dict[int, Lease] = {}
        self._checked_s = 0.0
        self._sequence = 0  # of the list at the last check; 0: the source has had no injections

    def __contains__(self, number: int) -> bool:
        return number in self._leases

    def add(self, number: int, sender: str, *, keep: bool) -> Lease:
        """Add an injection that a command is about to create."""
        lease = self._leases[number] = Lease(sender, keep)
        return lease

    def remove(self, number: int) -> None:
        """Remove an injection that was not created."""
        self._leases.pop(number, None)

    def renew(self, numbers: list[int], sender: str) -> None:
        """Renew those injections that the cell ``sender`` has created."""
        for number in numbers:
            lease = self._leases.get(number)
            if lease is not None and lease.sender in ("", sender):
                lease.sender, lease.renewed_s = sender, time.monotonic()

    def sender_of(self, number: int) -> str:
        """Return the cell that has created an injection; empty if it is not known, or none has."""
        lease = self._leases.get(number)
        return "" if lease is None else lease.sender

    def expired(self) -> list[tuple[int, Lease]]:
        """Return the injections to lift now, at most each ``CHECK_S``. Forget those that are lifted."""
        now_s = time.monotonic()
        sequence = self._block.injections.sequence
        if (not self._leases and sequence == self._sequence) or now_s - self._checked_s < CHECK_S:
            return []
        self._checked_s = now_s
        entries = self._block.injections.try_read()
        if entries is None:  # it says nothing about what is lifted
            return []
        self._sequence = sequence
        present = {one.number for one in entries}
        self._leases = {number: one for number, one in self._leases.items() if one.open or number in present}
        for one in entries:
            if one.writer == self._writer and not one.keep and one.number not in self._leases:
                self._leases[one.number] = Lease("", keep=False, open=False)
        return [
            (number, one)
            for number, one in self._leases.items()
            if not (one.open or one.keep) and now_s - one.renewed_s > LEASE_S
        ]


class StateFeed:
    """Follows the list of a source's injections and the mode of the clock."""

    def __init__(self, feed: Feed, leases: Leases, feeds: Mapping[str, Feed]) -> None:
        """Follow the source of a feed; ``feeds`` are those of all published sources."""
        self._feed, self._leases, self._feeds = feed, leases, feeds
        self._block = feed.block
        self._seen: tuple[int, bool] = (0, False)  # a source that has no injection yet publishes nothing
        self._asked_s = -ASKED_S
        self.wanted = False
        """True if a mirror has asked for the state."""

    def read(self) -> SourceState | None:
        """Return the state if it has changed or is wanted, else None.

        Call this after events were read, and publish the state before them: the source changes its
        list first.
        """
        virtual = self._block.clock.last_written().virtual
        seen = self._block.injections.sequence, virtual  # before the list: a change meanwhile is noticed next time
        now_s = time.monotonic()
        asked = self.wanted and now_s - self._asked_s >= ASKED_S
        if seen == self._seen and not asked:
            return None
        present = self._block.injections.try_read()
        if present is None:
            return None
        if asked:
            self._asked_s = now_s
        self._seen, self.wanted = seen, self.wanted and not asked
        entries = [entry for one in present if (entry := self._published(one)) is not None]
        return SourceState(tuple(entries), self._block.clock.present_ns(), virtual)

    def _published(self, one: InjectionEntry) -> InjectionEntry | None:
        """Return what other cells may know of an injection; None: nothing.

        These are the published bits that it covers, and the declaration if it names only what is
        published. Otherwise the declaration says only which published registers the injection changes.
        """
        feed, running, cell = self._feed, one.running, self._leases.sender_of(one.number)
        ranges = tuple(feed.published(one.ranges))
        if not ranges:
            return None
        if running is not None and not cell and not (feed.covers(one.ranges) and self._knows(running.declaration)):
            own = running.declaration
            covered = [Write(offset, 0 if mask == 0xFF else mask, bytes(size)) for offset, size, mask in ranges]
            paths = [f"{self._block.source}/{path}" for path in paths_of(feed.layout, covered, MAX_TARGETS)]
            shown = Declaration(name=own.name, target=paths, operation=own.operation, priority=own.priority)
            running = msgspec.structs.replace(running, declaration=shown)
        return msgspec.structs.replace(one, cell=cell, ranges=ranges, running=running)

    def _knows(self, declaration: Declaration) -> bool:
        """Return whether a condition reads only registers that are published."""
        if declaration.when is None:
            return True
        default = self._block.source if len(self._feeds) == 1 else None
        try:
            for one in nodes(parse_condition(declaration.when)):
                if isinstance(one, Reference):
                    topic = parse_topic(one.path, self._feeds, default)
                    find(self._feeds[topic.source].layout, topic.path)
        except (ConfigError, PathError, KeyError):
            return False
        return True


def declaration_refusal(data: bytes, own: Feed, feeds: Mapping[str, Feed]) -> str:
    """Return why another cell may not declare an injection; empty if it may. The source checks it, too.

    A declaration may read and change only what the cell publishes. For a large layout this takes
    seconds.

    Args:
        data: The declaration as JSON.
        own: The feed of the source to which it was sent.
        feeds: The feeds of all published sources.

    """
    try:
        declaration = decode_declaration(data)
        check_declarations([declaration])
        periods_ns = {source: feed.block.period_ns for source, feed in feeds.items()}
        program = compile_program(declaration, {source: feed.layout for source, feed in feeds.items()}, periods_ns)
        if program.source != own.block.source:
            return f"target: it names source {program.source}, but the command was sent to {own.block.source}"
        if not own.partial:
            return ""
        whole = compile_program(declaration, {source: feed.block.layout for source, feed in feeds.items()}, periods_ns)
    except (msgspec.MsgspecError, UnicodeDecodeError, ConfigError, RecursionError) as error:
        return str(error)
    cover = whole.cover.tobytes()
    if not own.publishes(Write(at, bits, bits.to_bytes()) for at, bits in enumerate(cover) if bits):
        return "target: it covers registers that this cell does not publish; name the registers one by one"
    return ""
