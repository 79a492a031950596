"""Plans the jobs that read the registers of a tag table, and the items of each job. No I/O."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from shmio.connectors.s7 import pdu
from shmio.layout.s7.address import Area

MAX_ITEMS: Final = 20
"""Maximum number of items in a job; all known controllers accept as many."""
MAX_GAP: Final = 16
"""Maximum number of unused bytes between two fields of a range; reading them costs about as much as another item."""
_REQUEST_HEAD, _REQUEST_ITEM = 12, 12
_ANSWER_HEAD, _ANSWER_ITEM = 14, 4
_OPEN_JOBS: Final = 8  # largest number of jobs in which to look for room, so that planning takes linear time


class Field(NamedTuple):
    """The bytes of a register in the controller's memory."""

    register: int
    """Index of the register in the layout."""
    area: Area
    db: int
    start: int
    """Offset of the first byte. For a timer or counter, twice its number."""
    stop: int
    every: int = 1
    """The field is read once in this number of cycles."""


class Range:
    """Consecutive bytes that contain one or more fields."""

    def __init__(self, fields: Sequence[Field]) -> None:
        self.fields = tuple(fields)
        self.area, self.db = Area(fields[0].area), fields[0].db
        self.every = fields[0].every
        self.start = min(one.start for one in fields)
        self.stop = max(one.stop for one in fields)
        self.alone = False
        """True if the range needs its own job, because the controller refused the job that it shared."""
        self.last = b""
        """The last bytes of the range that were stored in the image."""

    def halves(self) -> list[Range]:
        """Return two ranges with half of the fields each; for a range with one field, only this range."""
        middle = len(self.fields) // 2
        if not middle:
            return [self]
        found = [Range(self.fields[:middle]), Range(self.fields[middle:])]
        for one in found:
            one.alone = self.alone
        return found


class Piece(NamedTuple):
    """The part of a range that one item reads, which is nearly always the whole range."""

    range: Range
    start: int
    size: int

    @property
    def address(self) -> bytes:
        """The item's encoded address."""
        area = self.range.area
        if area.numbered:
            return pdu.address(0, self.start // 2, self.size // 2, area, area)  # type and area have the same code
        return pdu.address(self.range.db, 8 * self.start, self.size, area=area)


Job = tuple[Piece, ...]


def merge(fields: Iterable[Field], most: int, max_gap: int = MAX_GAP) -> list[Range]:
    """Return ranges that cover the fields.

    Fields that are read at different rates do not share a range. A range has at most ``most``
    bytes, unless its only field is longer.
    """
    ranges: list[Range] = []
    run: list[Field] = []
    stop = 0
    for one in sorted(fields, key=lambda field: (field.every, field.area, field.db, field.start, field.stop)):
        if run and (
            (one.every, one.area, one.db) != (run[0].every, run[0].area, run[0].db)
            or one.start > stop + (0 if one.area.numbered else max_gap)
            or max(stop, one.stop) - run[0].start > most
        ):
            ranges.append(Range(run))
            run = []
        stop = max(stop, one.stop) if run else one.stop
        run.append(one)
    if run:
        ranges.append(Range(run))
    return ranges


def most_bytes(pdu_size: int) -> int:
    """Return the maximum number of bytes that an item can read with a PDU of ``pdu_size`` bytes.

    The result is even, because timers and counters have two bytes each.
    """
    return pdu_size - _ANSWER_HEAD - _ANSWER_ITEM & ~1


def pack(ranges: Iterable[Range], pdu_size: int) -> list[Job]:
    """Return jobs of at most ``MAX_ITEMS`` items, whose requests and answers fit into a PDU."""
    jobs: list[list[Piece]] = []
    room: list[tuple[int, int]] = []  # of each job: bytes left in the answer, and items left
    items = min(MAX_ITEMS, (pdu_size - _REQUEST_HEAD) // _REQUEST_ITEM)
    whole = pdu_size - _ANSWER_HEAD
    for piece in _pieces(ranges, most_bytes(pdu_size)):
        need = _ANSWER_ITEM + piece.size + (piece.size & 1)
        place = len(jobs)
        if not piece.range.alone:
            recent = range(max(0, len(jobs) - _OPEN_JOBS), len(jobs))
            place = next((at for at in recent if room[at][0] >= need and room[at][1]), place)
        if place == len(jobs):
            jobs.append([])
            room.append((whole, 1 if piece.range.alone else items))
        jobs[place].append(piece)
        room[place] = room[place][0] - need, room[place][1] - 1
    return [tuple(job) for job in jobs]


def _pieces(ranges: Iterable[Range], most: int) -> Iterator[Piece]:
    for one in ranges:
        for start in range(one.start, one.stop, most):
            yield Piece(one, start, min(most, one.stop - start))
