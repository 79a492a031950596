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
from shmio.errors import ConfigError
from shmio.fabric.messages import SourceState
from shmio.injection import compile_program
from shmio.layout.values.write import Write
from shmio.segment import Block
from shmio.segment.injection_list import InjectionEntry

LEASE_S: Final = 5.0
"""Time in s without a renewal after which an injection of another cell is lifted."""
CHECK_S: Final = 0.4
"""Interval in s for checking the leases."""

_DECLARATIONS: Final = msgspec.json.Decoder(Declaration)  # created before there are threads


@dataclass
class Lease:
    """An injection that another cell has created.

    Attributes:
        sender: The cell.
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
    must lift those that their cells no longer renew, because a cell or the connection to it is down.
    """

    def __init__(self, block: Block) -> None:
        self._block = block
        self._leases: dict[int, Lease] = {}
        self._checked_s = 0.0

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
            if lease is not None and lease.sender == sender:
                lease.renewed_s = time.monotonic()

    def sender_of(self, number: int) -> str:
        """Return the cell that has created an injection; empty if it is not known, or none has."""
        lease = self._leases.get(number)
        return "" if lease is None else lease.sender

    def expired(self) -> list[tuple[int, Lease]]:
        """Return the injections to lift now, at most each ``CHECK_S``. Forget those that are lifted."""
        now_s = time.monotonic()
        if not self._leases or now_s - self._checked_s < CHECK_S:
            return []
        self._checked_s = now_s
        present = {one.number for one in self._block.injections.read()}
        self._leases = {number: one for number, one in self._leases.items() if one.open or number in present}
        return [
            (number, one)
            for number, one in self._leases.items()
            if not (one.open or one.keep) and now_s - one.renewed_s > LEASE_S
        ]


class StateFeed:
    """Follows the list of a source's injections and the mode of the clock."""

    def __init__(self, feed: Feed, leases: Leases) -> None:
        self._feed, self._leases = feed, leases
        self._block = feed.block
        self._seen: tuple[int, bool] = (0, False)  # a source that has no injection yet publishes nothing
        self.wanted = False
        """True if a mirror has asked for the state."""

    def read(self) -> SourceState | None:
        """Return the state if it has changed or is wanted, else None.

        Call this after events were read, and publish the state before them: the source changes its
        list first.
        """
        virtual = self._block.clock.last_written().virtual
        seen = self._block.injections.sequence, virtual  # before the list: a change meanwhile is noticed next time
        if seen == self._seen and not self.wanted:
            return None
        self._seen, self.wanted = seen, False
        entries = [
            msgspec.structs.replace(one, cell=self._leases.sender_of(one.number))
            for one in self._block.injections.read()
            if self._feed.shows(one.ranges)
        ]
        return SourceState(tuple(entries), self._block.clock.present_ns(), virtual)


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
        declaration = _DECLARATIONS.decode(data)
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


def covers_only_published(one: InjectionEntry, feed: Feed) -> bool:
    """Return whether an injection covers only registers that are published, so that other cells may change it."""
    return all(feed.publishes([Write(offset, mask, bytes(size))]) for offset, size, mask in one.ranges)
