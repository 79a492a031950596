"""The S7 connector for tag tables: registers at addresses in several blocks and areas.

If the controller refuses a range, the same read halves the range until the refused registers are
known. Only these registers turn bad. They are tried again from time to time, and are read as usual
once the controller no longer refuses them. The connector remembers refused registers when the
connection is lost.
"""

from __future__ import annotations

import logging
import time
from bisect import insort
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

from shmio.connectors.base import Connector
from shmio.connectors.register_image import RegisterImage, no_status_area
from shmio.connectors.request_count import CycleRequests
from shmio.connectors.s7 import cpu, pdu
from shmio.connectors.s7.block_check import BlockChangeMonitor, ExpectedBlock
from shmio.connectors.s7.blocks import ITEM_OVERHEAD, JOB_OVERHEAD, BlockWrite, WriteItem, bit_item, byte_item, touches
from shmio.connectors.s7.explain import (
    ACCESS_DENIED,
    ITEM_OK,
    NO_SUCH_OBJECT,
    NO_SUCH_TYPE,
    OTHER_SIZE,
    OUT_OF_RANGE,
    RefusedError,
    explain_item,
    explain_place,
)
from shmio.connectors.s7.plan import Field, Job, Piece, Range, merge, most_bytes, pack
from shmio.connectors.s7.request_count import NOTE, by_pdu_size
from shmio.connectors.s7.session import MAX_DEPTH, REGISTER_OPTIONS, Read, S7Options, S7Session
from shmio.connectors.s7.tag import Tag
from shmio.errors import ConfigError, PathError
from shmio.layout.glob import Glob
from shmio.layout.model import Layout
from shmio.layout.s7.address import Area, is_of_cpu, parse
from shmio.layout.topic import shorten
from shmio.layout.values.write import Write, apply
from shmio.model.statuses import (
    BAD_COMMUNICATION_ERROR,
    BAD_NODE_ID_UNKNOWN,
    BAD_NOT_SUPPORTED,
    BAD_OUT_OF_RANGE,
    BAD_TYPE_MISMATCH,
    BAD_USER_ACCESS_DENIED,
    GOOD,
    UNCERTAIN,
)
from shmio.wording import counted

RETRY_NS: Final = 10_000_000_000
"""Time in ns after which a refused register is tried again."""
MAX_RETRIED: Final = 20
"""Maximum number of refused registers that one read tries again."""
_STATUS: Final = {
    ACCESS_DENIED: BAD_USER_ACCESS_DENIED,
    OUT_OF_RANGE: BAD_OUT_OF_RANGE,
    NO_SUCH_TYPE: BAD_NOT_SUPPORTED,
    OTHER_SIZE: BAD_TYPE_MISMATCH,
    NO_SUCH_OBJECT: BAD_NODE_ID_UNKNOWN,
}
_AREA_NAMES: Final = {
    Area.PERIPHERAL: "peripheral inputs", Area.INPUT: "inputs", Area.OUTPUT: "outputs", Area.MARKER: "markers",
    Area.COUNTER: "counters", Area.TIMER: "timers",
}  # fmt: skip
MAX_PLACES: Final = 200
"""Maximum length, in characters, of a text that lists blocks and areas."""
_MOST_LOGGED: Final = 20  # largest number of refused registers that the log names one by one

log = logging.getLogger("shmio.source")


class Planner:
    """Decides which ranges each cycle reads, and remembers the registers that the controller refuses."""

    def __init__(self, tags: Mapping[int, Tag]) -> None:
        """Create a planner for tags, given by their indices in the layout."""
        self._tags = tags
        self.pdu_size = 0
        self._ranges: dict[Range, None] = {}  # a set in order
        self._rates = sorted({tag.field.every for tag in tags.values()})
        self._jobs: dict[tuple[int, ...], list[Job]] = {}  # by the rates that are due
        self._cycle = 0
        self.refused: dict[Field, tuple[int, int]] = {}
        """For each refused field, its status and the time to try it again, CLOCK_MONOTONIC in ns."""
        self.changes: dict[int, int] = {}
        """Statuses of refused registers that are not in the image yet, by index in the layout."""

    def use(self, pdu_size: int) -> None:
        """Plan for the PDU size of a new session. The session's first read includes all registers.

        The planner keeps what it knows about refused registers.
        """
        self._cycle = 0
        if pdu_size != self.pdu_size:
            self.pdu_size = pdu_size
            self._merge()

    def jobs(self, now_ns: int) -> list[Job]:
        """Return the jobs of the next read. They include refused registers that it is time to try again."""
        jobs = self._due(self._cycle)
        self._cycle += 1
        if not self.refused:
            return jobs
        due: list[Range] = []
        for field, (status, at_ns) in self.refused.items():
            if at_ns <= now_ns and len(due) < MAX_RETRIED:
                due.append(Range([field]))
                self.refused[field] = status, now_ns + RETRY_NS
        return jobs + pack(due, self.pdu_size) if due else jobs

    @property
    def count(self) -> int:
        """Maximum number of jobs in a cycle, without those that try refused registers again."""
        return len(self._due(0))

    def _due(self, cycle: int) -> list[Job]:
        """Return the jobs of a cycle. Cycle 0 reads all registers."""
        rates = tuple(rate for rate in self._rates if cycle % rate == 0)
        jobs = self._jobs.get(rates)
        if jobs is None:
            jobs = self._jobs[rates] = pack((one for one in self._ranges if one.every in rates), self.pdu_size)
        return jobs

    def split(self, whole: Range, parts: Sequence[Range]) -> None:
        """From now on, read ``parts`` instead of the range ``whole``, provided that ``whole`` is still being read."""
        if whole in self._ranges:
            del self._ranges[whole]
            self._ranges |= dict.fromkeys(parts)
            self._jobs = {}

    def replan(self) -> None:
        """Divide the ranges into jobs anew, because some ranges now need a job of their own."""
        self._jobs = {}

    def together(self, ranges: Iterable[Range]) -> None:
        """Let ranges share jobs again, because the cause of the refusals is now known."""
        for whole in ranges:
            if whole.alone:
                whole.alone = False
                self._jobs = {}

    def refuse(self, part: Range, status: int, why: str) -> None:
        """Remember that the only field of a range is refused; try it again only after ``RETRY_NS``."""
        field = part.fields[0]
        if field not in self.refused:
            self._note(field, why)
        self.refused[field] = status, time.monotonic_ns() + RETRY_NS
        self.changes[field.register] = status
        self.split(part, ())

    def explain(self, part: Range, code: int) -> str:
        """Return a message for the return code of an item that reads a range."""
        tag = self._tags[part.fields[0].register]
        if len(part.fields) > 1:
            return explain_item(code)
        return explain_place(code, tag.address.text, tag.address.db, part.stop - 1)

    def accept(self, part: Range) -> None:
        """Treat the fields of a range as no longer refused, and read them together with other fields again."""
        if self.refused and any(field in self.refused for field in part.fields):
            for field in part.fields:
                if self.refused.pop(field, None):
                    self.changes.pop(field.register, None)
                    log.info("%s can be read again", self._named(field))
            self._merge()

    def forget(self) -> None:
        """Make the next read store the values of all ranges, even values that have not changed."""
        for one in self._ranges:
            one.last = b""

    def _merge(self) -> None:
        fields = (tag.field for tag in self._tags.values() if tag.field not in self.refused)
        self._ranges = dict.fromkeys(merge(fields, most_bytes(self.pdu_size)))
        self._jobs = {}

    def _named(self, field: Field) -> str:
        tag = self._tags[field.register]
        return f"{tag.register.path} ({tag.address.text})"

    def _note(self, field: Field, why: str) -> None:
        if len(self.refused) < _MOST_LOGGED:
            log.warning("%s is bad: %s", self._named(field), why)
        elif len(self.refused) == _MOST_LOGGED:
            log.warning("more registers are refused; they are not listed here, but their status says why")


class TableRead:
    """The read of one cycle: its jobs, and the bytes in their answers."""

    def __init__(
        self, planner: Planner, again: Callable[[TableRead], None], store: Callable[[TableRead], bytes]
    ) -> None:
        """Create a read.

        Args:
            planner: Returns the jobs of the read.
            again: Called to queue the read again, after jobs were added to it.
            store: Stores the results in the image, and returns the image.

        """
        self._planner, self._again, self._store = planner, again, store
        self.begin(0)

    def begin(self, deadline_ns: int) -> None:
        """Start a read that must be complete by ``deadline_ns``."""
        self.deadline_ns = deadline_ns
        self.begun_ns = time.time_ns()
        """UTC time of the start, in ns since 1970."""
        self.refusal: RefusedError | None = None
        self.sent = self._answered = self._denied = 0
        self._jobs: list[Job] = list(self._planner.jobs(time.monotonic_ns())) if deadline_ns else []
        self._denial: RefusedError | None = None
        self._again_alone: dict[Range, None] = {}
        self._codes: dict[Range, tuple[int, str]] = {}
        self._gone: set[Range] = set()  # ranges that were refused
        self._parts: list[Range] = []  # halves of these, which the next jobs read
        self.data_of: dict[Range, bytearray] = {}
        """The bytes of each range that was received."""
        self._found = False  # whether a refused register was found

    @property
    def count(self) -> int:
        """Number of jobs so far. Refused ranges lead to more jobs."""
        return len(self._jobs)

    @property
    def complete(self) -> bool:
        """True if the controller has answered all jobs so far."""
        return self._answered == len(self._jobs)

    @property
    def data(self) -> bytes:
        """The image; valid only if the read is complete and was not refused as a whole."""
        return self._store(self)

    def take(self, count: int, first: int) -> bytes:
        """Return the next ``count`` requests. Their references are 16-bit numbers from ``first`` on, which wrap."""
        begin, self.sent = self.sent, self.sent + count
        return b"".join(
            pdu.read_request((first + place) & 0xFFFF, [piece.address for piece in job])
            for place, job in enumerate(self._jobs[begin : self.sent])
        )

    def accept(self, index: int, frame: memoryview) -> None:
        """Process the answer to job number ``index``.

        After the last answer, add jobs for the halves of refused ranges.

        Raises:
            ConnectorError: The answer does not match the request.

        """
        job = self._jobs[index]
        try:
            answers = pdu.parse_items(frame, [piece.size for piece in job])
        except RefusedError as refusal:
            self._refuse_all(job, refusal)
        else:
            for piece, answer in zip(job, answers, strict=True):
                if answer.code == ITEM_OK:
                    self._put(piece, answer.data)
                else:
                    status = _STATUS.get(answer.code, BAD_COMMUNICATION_ERROR)
                    self._refuse(piece.range, status, self._planner.explain(piece.range, answer.code))
        self._answered += 1
        if self.complete:
            self._settle()

    def _put(self, piece: Piece, data: memoryview) -> None:
        whole = piece.range
        if whole in self._gone:
            return
        buffer = self.data_of.get(whole)
        if buffer is None:
            buffer = self.data_of[whole] = bytearray(whole.stop - whole.start)
        at = piece.start - whole.start
        buffer[at : at + piece.size] = data

    def _refuse(self, whole: Range, status: int, why: str) -> None:
        """Halve a range that the controller refused; if it has only one register, remember that as refused.

        The planner stores the result at once. So if the session ends before the search does, the
        next session continues the search.
        """
        if whole in self._gone:
            return
        self._gone.add(whole)
        self.data_of.pop(whole, None)
        halves = whole.halves()
        if len(halves) > 1:
            self._planner.split(whole, halves)
            self._parts += halves
        else:
            self._planner.refuse(whole, status, why)
            self._found = True

    def _refuse_all(self, job: Job, refusal: RefusedError) -> None:
        """Remember that the controller refused a whole job, perhaps because of only one of its items."""
        self._denied += 1
        self._denial = refusal
        ranges = dict.fromkeys(piece.range for piece in job)
        for whole in ranges:
            if len(ranges) > 1:
                whole.alone = True
                self._again_alone[whole] = None
            else:
                self._codes[whole] = BAD_COMMUNICATION_ERROR, str(refusal)

    def _settle(self) -> None:
        """Halve refused ranges and queue jobs for the halves; if there are none, update the planner."""
        refused, self._codes = self._codes, {}
        planner = self._planner
        if self._denied == len(self._jobs) and self._jobs and not self._again_alone:
            self.refusal = self._denial  # every job was refused, so single addresses are not the cause
            planner.together(refused)
            return
        for whole, (status, why) in refused.items():
            self._refuse(whole, status, why)
        parts = [*self._again_alone, *self._parts]
        self._again_alone, self._parts = {}, []
        if parts:
            planner.replan()
            self._jobs += pack(parts, planner.pdu_size)
            self._again(self)
            return
        for whole in self.data_of:
            if len(whole.fields) == 1:
                planner.accept(whole)
        if self._found:
            planner.together(self.data_of)


class TableWrite(BlockWrite):
    """One wave of writes to registers of a tag table."""

    def __init__(self, pdu_size: int, items: Sequence[WriteItem], outcomes: list[str], names: dict[int, str]) -> None:
        """Create a wave; ``names`` are the names of the written registers by the index of the write."""
        super().__init__(0, pdu_size, items, outcomes)
        self._names = names

    def _reason(self, item: WriteItem, code: int) -> str:
        return f"{self._names[item.write]}: {explain_item(code)}"


class S7TableConnector(S7Session, Connector):
    """Reads and writes registers at the addresses of a tag table."""

    Options = S7Options
    can_write = True
    register_quality = True
    register_options = REGISTER_OPTIONS

    def __init__(self, options: S7Options, layout: Layout) -> None:
        """Create the connector without connecting it.

        Raises:
            ConfigError: A register has no address, or an address that does not fit its type.

        """
        super().__init__(options)
        if options.dbNumber is not None:
            raise ConfigError("dbNumber: leave out this key, because each address of a tag table names its block")
        self._layout = layout
        self._tags: dict[int, Tag] = {}
        of_cpu: list[cpu.CpuTag] = []
        rates = _rates(options.every, layout)
        for index, register in enumerate(layout.registers):
            try:
                if is_of_cpu(register.address):
                    of_cpu.append(cpu.parse(index, register))
                    continue
                address = parse(register)
                if register.writable and address.area.read_only:
                    raise ValueError(f"writable: {address.area.read_only}")
            except ValueError as error:
                raise ConfigError(f"layout: {register.path}: {error}") from None
            rate = next((every for glob, every in rates if glob.matches(register.path)), 1)
            self._tags[index] = Tag(index, register, address, layout.byte_order, rate)
        if not self._tags:
            raise ConfigError(
                "layout: the tag table has only values of the CPU; add a register with an address such as %MB0"
            )
        self._of_cpu = of_cpu
        self._cpu = cpu.CpuValues(of_cpu, self._mode)
        self._watch = BlockChangeMonitor(_described(self._tags.values()))
        self._uncertain: frozenset[int] = frozenset()  # numbers of blocks that no longer fit
        for query in (*self._cpu.queries, self._watch):
            self._add_query(query)
        self._planner = Planner(self._tags)
        self._image = RegisterImage(layout) if layout.status_offset is not None else None

    def describe(self) -> str:
        """Return, for the log, the peer, the session's parameters and the number of requests in a cycle."""
        requests = self._planner.count
        return (
            f"to {self.options.peer} {len(self._layout.registers)} registers pdu={self.pdu_size} jobs={self.jobs} "
            f"depth={self.depth} in {requests} {'request' if requests == 1 else 'requests'} a cycle"
        )

    def cycle_requests(self) -> CycleRequests:
        """Return the requests of a cycle that reads all registers, for each possible PDU size."""

        def count(pdu_size: int) -> int:
            planner = Planner(self._tags)
            planner.use(self._used(pdu_size))
            return planner.count

        fields = [tag.field for tag in self._tags.values()]
        places = dict.fromkeys(
            f"DB{one.db}" if one.area is Area.BLOCK else _AREA_NAMES[one.area]
            for one in sorted(fields, key=lambda one: (one.area is not Area.BLOCK, one.area, one.db))
        )
        slow = sum(one.every > 1 for one in fields)
        reads = f"{counted(len(fields), 'register')} in {shorten(', '.join(places), MAX_PLACES)}"
        reads += f", {slow} of them not in each cycle" if slow else ""
        beside = (
            f"; values of the CPU ({counted(len(self._of_cpu), 'register')}) are requested in addition"
            if self._of_cpu
            else ""
        )
        return CycleRequests(reads, by_pdu_size(count), NOTE + beside)

    # -- reading -------------------------------------------------------------------------------------------------------

    def _used(self, pdu_size: int) -> int:
        """Return the PDU size that requests use if the controller has granted ``pdu_size``."""
        limit = self.options.packetSize or pdu_size
        return min(pdu_size, max(pdu.MIN_PDU_SIZE, limit + pdu.READ_OVERHEAD))

    def _reads(self) -> list[Read]:
        if self._image is None:
            raise no_status_area()
        self._cpu.begin()
        self._planner.use(self._used(self.pdu_size))
        requests = max(1, self._planner.count)
        depth = min(max(1, self.jobs // requests), MAX_DEPTH)
        return [TableRead(self._planner, self._queue_again, self._store) for _ in range(depth)]

    def _queue_again(self, read: TableRead) -> None:
        self._window.add(read, urgent=True)

    def _store(self, read: TableRead) -> bytes:
        """Store the results of a read in the image, and return a copy of the image."""
        image = self._image
        assert image is not None  # noqa: S101 - _reads() checked it
        self._cpu.store(image)
        planner = self._planner
        for index, status in planner.changes.items():
            image.fail(index, status)
        planner.changes.clear()
        if self._watch.doubts.keys() != self._uncertain:
            self._uncertain = frozenset(self._watch.doubts)
            planner.forget()
        for whole, data in read.data_of.items():
            code = UNCERTAIN if whole.area is Area.BLOCK and whole.db in self._uncertain else GOOD
            # To a register that is read in every cycle, the time of the frame applies.
            source_ns = read.begun_ns if whole.every > 1 else 0
            if whole.last == data and not source_ns:  # the image already has these values
                continue
            whole.last = bytes(data)
            for field in whole.fields:
                if planner.refused and field in planner.refused:  # by another read; the image keeps the bad status
                    continue
                tag = self._tags[field.register]
                found = tag.image_bytes(whole.last[field.start - whole.start : field.stop - whole.start])
                if found is None:
                    image.fail(field.register, BAD_OUT_OF_RANGE, source_ns)
                else:
                    image.put_bytes(field.register, found, source_ns, code)
        return bytes(image)

    # -- writing -------------------------------------------------------------------------------------------------------

    def _waves(self, writes: Sequence[Write], outcomes: list[str]) -> Iterator[BlockWrite]:
        wave: list[WriteItem] = []
        names: dict[int, str] = {}
        spans: list[tuple[int, int]] = []  # sorted ranges of bits that the wave writes
        for place, write in enumerate(writes):
            try:
                steps = list(self._steps(write))
            except ValueError as error:
                outcomes[place] = str(error)
                continue
            for tag, start, bit, data in steps:
                first = _linear(tag, start, bit)
                span = first, first + (8 * len(data) if bit is None else 1)
                if wave and touches(spans, span):
                    yield TableWrite(self.pdu_size, wave, outcomes, names)
                    wave, spans = [], []
                insort(spans, span)
                names[place] = f"{tag.register.path} ({tag.address.text})"
                wave += self._items(place, tag, start, bit, data)
        if wave:
            yield TableWrite(self.pdu_size, wave, outcomes, names)

    def _items(self, place: int, tag: Tag, start: int, bit: int | None, data: bytes) -> Iterator[WriteItem]:
        area, db = tag.address.area, tag.address.db
        if bit is not None:
            yield WriteItem(place, start, bit_item(db, start, bit, bool(data[0] >> bit & 1), area))
            return
        most = self.pdu_size - JOB_OVERHEAD - ITEM_OVERHEAD
        for at in range(0, len(data), most):
            part = data[at : at + most]
            yield WriteItem(place, start + at + len(part) - 1, byte_item(db, start + at, part, area))

    def _steps(self, write: Write) -> Iterator[tuple[Tag, int, int | None, bytes]]:
        """Yield each change that a write makes in the controller, as (tag, first byte, bit, data).

        Raises:
            ValueError: The controller cannot hold the value, or the write sets no register, or one
                that cannot be written.

        """
        offset, mask, data = write
        found = False
        for tag in self._tags.values():
            register = tag.register
            if register.offset + register.size <= offset or register.offset >= offset + len(data):
                continue
            if register.bit is not None and not register.dims and mask and mask != 1 << register.bit:
                continue
            if tag.address.area.read_only:
                raise ValueError(f"{register.path} ({tag.address.text}): {tag.address.area.read_only}")
            for start, bits, value in self._device_writes(tag, write):
                found = True
                yield tag, tag.address.start + start, bits.bit_length() - 1 if bits else None, value
        if not found:
            if any(
                one.register.offset < offset + len(data) and offset < one.register.offset + one.register.size
                for one in self._of_cpu
            ):
                raise ValueError("values of the CPU can only be read")
            raise ValueError("no register of the tag table covers the written bytes")

    def _device_writes(self, tag: Tag, write: Write) -> Iterator[Write]:
        """Yield the writes to one register, with offsets from its address in the controller."""
        register, mask = tag.register, write.mask
        if mask and register.type != "BOOL":
            yield Write(tag.device_bit(write.offset - register.offset), mask, write.data)
            return
        image, covered = bytearray(self._layout.size), bytearray(self._layout.size)
        apply(write, image)
        apply(write._replace(data=b"\xff" * len(write.data)), covered)
        own = slice(register.offset, register.offset + register.size)
        yield from tag.device_writes(bytes(image[own]), bytes(covered[own]))


def _described(tags: Iterable[Tag]) -> Iterator[ExpectedBlock]:
    """Yield a description of each data block that contains registers of these tags."""
    fields: dict[int, list[tuple[int, int, str]]] = {}
    for tag in tags:
        if tag.address.area is Area.BLOCK:
            end = tag.field.stop
            fields.setdefault(tag.address.db, []).append(
                (tag.field.start, end, f"{tag.register.path} ({tag.address.text})")
            )
    for db_number, found in sorted(fields.items()):
        ends = [(end, name) for _, end, name in sorted(found)]
        yield ExpectedBlock(db_number, "", max(end for end, _ in ends), ends, whole=False)


def _rates(every: dict[str, int], layout: Layout) -> list[tuple[Glob, int]]:
    """Return the patterns of the key ``every`` with their numbers of cycles.

    Raises:
        ConfigError: A pattern is malformed, or matches no register.

    """
    rates = []
    for pattern, rate in every.items():
        try:
            glob = Glob(pattern)
        except PathError as error:
            raise ConfigError(f"every: {error}") from None
        if not any(glob.matches(register.path) for register in layout.registers):
            raise ConfigError(f"every: {pattern!r} matches no register of the layout")
        rates.append((glob, rate))
    return rates


def _linear(tag: Tag, start: int, bit: int | None) -> int:
    """Return the number of a bit in a sequence of all bits of all areas and blocks."""
    return ((tag.address.area << 16 | tag.address.db) << 24) + 8 * start + (bit or 0)
