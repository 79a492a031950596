"""Updates of a source's registers, and the tables that they refer to."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from shmio.client.table import Array, Change, SubscribeResponse, Table, unknown
from shmio.errors import QualityError, RemoteError
from shmio.layout import model
from shmio.model.statuses import worse
from shmio.model.values import Column, Provenance, Quality, Reading
from shmio.wire import shmio_v1_pb2 as wire


class Piece(NamedTuple):
    """Raw bytes of a frame from ``offset`` on. ``mask`` selects bits of each byte; 0 selects all."""

    offset: int
    data: bytes
    mask: int = 0


class Update:
    """One frame of a source, or a change of its quality.

    If the direction of its table is ``in``, it has instead the values that a command wrote.
    ``update[path]`` is the latest value of a register.

    Attributes:
        changes: The received values; ``table.arrays`` has the latest values of all registers.
        clock_ns: Time since the instance's start, in ns.
        source_ns: UTC time of the values, in ns; 0 if there are no values yet.
        marked: True if the update also says which registers are invalid or injected.
        missed: Number of frames lost before this one; counted only with ``every_frame``.
        ended: True if a reload has removed the source, or all of its requested registers.
        image: The frame as consumers see it, if ``frames`` was requested.
        raw: The frame as the source delivered it, if ``frames`` was requested.
        age_ns: Age of the frame in ns, after a read.
        pieces: The changed bytes in the ranges of an injection over ranges.
    """

    __slots__ = (
        "_everything", "_originals", "_statuses", "age_ns", "changes", "clock_ns", "cycle", "ended", "frame", "image",
        "incarnation", "marked", "missed", "pieces", "provenance", "quality", "raw", "reason", "source_ns", "table",
        "whole",
    )  # fmt: skip

    def __init__(self, table: Table, found: Any) -> None:
        """Convert a message, and copy its values into the table. Raise RemoteError if it is invalid."""
        self.table = table
        self.frame: int = found.frame
        self.cycle: int = found.cycle
        self.incarnation: int = found.incarnation
        self.clock_ns: int = found.clock_ns
        self.source_ns: int = found.source_ns
        self.quality = _QUALITIES.get(found.quality, Quality.BAD)
        self.reason: str = found.reason
        self.provenance = _PROVENANCES.get(found.provenance, Provenance.SIMULATED)
        self.missed: int = found.missed
        self.whole: bool = found.whole
        self.image: bytes = found.image
        self.raw: bytes = found.original or found.image
        self.age_ns: int = found.age_ns
        self.pieces = tuple(Piece(one.offset, one.data, one.mask) for one in found.pieces)
        self.ended = False
        self.changes: tuple[Change, ...] = table.apply(found.values) if found.HasField("values") else ()
        self.marked = found.HasField("invalid") or found.HasField("injected")
        if found.HasField("invalid"):
            table.mark(found.invalid, table.invalid)
        if found.HasField("injected"):
            table.mark(found.injected, table.injected)
        self._statuses = table.take_statuses(found.statuses) if found.HasField("statuses") else []
        state = self.quality, self.reason.partition(":")[0], self.provenance, self.incarnation  # the age always changes
        self._everything = self.whole or self.marked or table.state != state
        table.state = state
        self._originals: Mapping[Column, Array] | None = None
        if found.HasField("originals"):
            self._originals = {change.column: change.values for change in table.read(found.originals)}

    @property
    def source(self) -> str:
        """Name of the source."""
        return self.table.source

    @property
    def changed(self) -> list[str]:
        """Paths of the registers in this update, with the source."""
        registers = self.table.registers
        return [f"{self.source}/{registers[place].path}" for place in self._changed()]

    def _changed(self) -> Sequence[int]:
        """Return the indices of registers with new values or statuses, in ascending order."""
        changed = self.table.changed(self.changes)
        return sorted({*changed, *self._statuses}) if self._statuses else changed

    @property
    def readings(self) -> list[Reading]:
        """Registers that may have changed since the previous update, with their latest values."""
        if self.ended:
            return []
        table = self.table
        places = range(len(table.registers)) if self._everything else self._changed()
        return [self.reading(place) for place in places]

    def reading(self, place: int, register: model.Register | None = None) -> Reading:
        """Return the reading of the register at index ``place`` of the table.

        ``register`` is the description of the register for the reading; None for that of the table.
        """
        found = self.table.registers[place]
        value: Any = self.table.value(place) if self.source_ns else None
        quality, reason = self.quality_of(found.path)
        status = self.table.status(place)
        source_ns = (status.source_ns if status else 0) or self.source_ns
        if status is not None and status.waits and not self.table.injected[place]:
            value, source_ns = None, 0
        return Reading(
            self.source,
            register or found,
            value.tolist() if hasattr(value, "tolist") else value,
            quality,
            reason,
            str(self.provenance_of(found.path)),
            source_ns / 1e9 if source_ns and self.source_ns else None,
            round(self.age_ns / 1e9, 6) if self.age_ns or quality is not Quality.BAD else None,
        )

    def __getitem__(self, path: str) -> Any:
        """Return a register's latest value, whatever its quality: see :meth:`Table.value`."""
        return self.table.value(self.table.place(path))

    def good(self, path: str) -> Any:
        """Return a register's value if it is good or uncertain.

        Raises:
            QualityError: The value is bad; the message gives the reason.
            PathError: There is no such register.
        """
        quality, reason = self.quality_of(path)
        if quality is Quality.BAD:
            raise QualityError(f"{self.source}/{path.removeprefix(f'{self.source}/')}: {reason}")
        return self[path]

    def original(self, path: str) -> Any:
        """Return a register's value without injections, after a read with ``originals``.

        Raises:
            PathError: There is no such register.
        """
        return self.table.value(self.table.place(path), self._originals)

    def quality_of(self, path: str) -> tuple[Quality, str]:
        """Return the quality of a register, and the reason if it is not good.

        Raises:
            PathError: There is no such register.
        """
        place = self.table.place(path)
        if self.quality is not Quality.BAD and self.table.invalid[place]:
            return Quality.BAD, f"the bytes are not a valid {self.table.registers[place].type}"
        status = self.table.status(place) if self.source_ns else None
        return (self.quality, self.reason) if status is None else worse(self.quality, self.reason, status)

    def provenance_of(self, path: str) -> Provenance:
        """Return the origin of a register's value.

        Raises:
            PathError: There is no such register.
        """
        return Provenance.INJECTED if self.table.injected[self.table.place(path)] else self.provenance


_NOTHING = SubscribeResponse.FromString(b"\x12\x00").updates[0]
_QUALITIES = {int(quality): quality for quality in Quality}
_PROVENANCES = {int(provenance): provenance for provenance in Provenance}


class Tables:
    """The tables that one stream, or the reads of a client, have received so far, by number."""

    def __init__(self) -> None:
        self.known: dict[int, Table] = {}

    def updates(self, found: Any) -> Iterator[Update]:
        """Yield the updates of a message, after adding the tables that the message has.

        Each update changes the table's arrays in place, so use it before you take the next.

        Raises:
            RemoteError: The message is invalid.
        """
        for one in found.tables:
            new = Table(one)
            self.known = {number: old for number, old in self.known.items() if not _same(old, new)}
            self.known[new.number] = new
        for update in found.updates:
            table = self.known.get(update.table)
            if table is None:
                raise RemoteError(f"the endpoint sent an update of table {update.table}, but not the table")
            yield Update(table, update)

    def all_of(self, found: Any) -> Iterator[Update]:
        """Yield all updates of a stream's message; those about sources that have ended come last."""
        yield from self.updates(found)
        for end in found.ended:
            direction = "in" if end.direction == wire.DIRECTION_IN else "out"
            for table in list(self.known.values()):
                if (table.source, table.direction) == (end.source, direction):
                    update = Update(table, _NOTHING)
                    update.reason, update.ended = end.reason, True
                    yield update


def _same(old: Table, new: Table) -> bool:
    """Return whether ``new`` replaces ``old``: both have the same source and direction."""
    return (old.source, old.direction) == (new.source, new.direction)


class Snapshot:
    """Result of one read, with an update for each source. Its paths include the source."""

    def __init__(self, updates: Iterable[Update]) -> None:
        self.updates = {update.source: update for update in updates}

    def __iter__(self) -> Iterator[str]:
        for update in self.updates.values():
            yield from update.table.paths

    def of(self, path: str) -> Update:
        """Return the update that has a register. The path may omit the source if only one was read.

        Raises:
            PathError: No update has the register.
        """
        update = self.updates.get(path.partition("/")[0])
        if update is None and len(self.updates) == 1:
            (update,) = self.updates.values()
        if update is None:
            raise unknown(path, list(self), f"the registers that were read of {', '.join(self.updates) or 'no source'}")
        return update

    def __getitem__(self, path: str) -> Any:
        """Return a register's value if it is good or uncertain: see :meth:`Update.good`."""
        return self.of(path).good(path)
