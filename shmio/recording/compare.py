"""Compares two recordings, frame by frame and event by event."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, groupby, islice, zip_longest
from typing import Any, Final, TypeVar

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import elements
from shmio.model.statuses import status_registers
from shmio.recording.dump import Dump
from shmio.recording.reading.part import DumpBlock, Entry
from shmio.segment import Event, EventKind, Frame, Provenance
from shmio.segment.changed_registers import ChangeScan
from shmio.segment.playhead import OWN_WORDS
from shmio.wording import unknown

EVENT_FIELDS: Final = ("kind", "quality", "text", "offset", "size", "mask", "data")
"""The fields of an event to compare: they are equal if the same happens in two runs."""
MAX_EVENTS: Final = 4096
"""Maximum number of events of one cycle to hold in memory at once, in order to match them.

While time is paused, one cycle may have any number of events.
"""
MAX_SHIFT: Final = 64
"""Number of frames to compare in order to align two recordings, from the first group that both have."""

T = TypeVar("T", Frame, Event)
_Pair = tuple[Entry[T] | None, Entry[T] | None]
_Groups = Iterator[tuple[int, Iterable[Entry[T]]]]


@dataclass(slots=True)
class RegisterDifference:
    """A register whose values differ in ``count`` frames.

    For the first pair of frames that differ, ``first`` has both log times, and ``values`` both
    values. ``largest`` is the largest difference in any pair; 0 if the values are not numbers.
    """

    count: int
    first: tuple[int, int]
    values: tuple[Value, Value]
    largest: float = 0.0


@dataclass(slots=True)
class Difference:
    """The first pair of frames or events that differ.

    ``times_ns`` and ``numbers`` have the log time and the number of the frame or event in each
    recording; None for a recording that lacks it. ``what`` says what differs.
    """

    times_ns: tuple[int | None, int | None]
    numbers: tuple[int | None, int | None]
    what: list[str]


@dataclass(slots=True)
class Side:
    """The result of comparing all frames, or all events, of one source."""

    compared: int = 0
    differing: int = 0
    only_first: int = 0
    only_second: int = 0
    first: Difference | None = None

    @property
    def same(self) -> bool:
        """True if both recordings have the same frames or events."""
        return not (self.differing or self.only_first or self.only_second)


class Timing:
    """Statistics of the time differences between matching frames of two recordings.

    Times are relative to the first matching frame of each recording. Percentiles are accurate to
    5 %. The memory use does not grow with the number of frames.
    """

    def __init__(self) -> None:
        self._bins: dict[int, int] = {}
        self._count = 0
        self._first: tuple[int, int] | None = None
        self.max_ns = 0

    def add(self, first_ns: int, second_ns: int) -> None:
        """Add the log times of two matching frames."""
        if self._first is None:
            self._first = first_ns, second_ns
        error_ns = abs((first_ns - self._first[0]) - (second_ns - self._first[1]))
        self.max_ns = max(self.max_ns, error_ns)
        place = round(math.log(error_ns + 1) * 20)
        self._bins[place] = self._bins.get(place, 0) + 1
        self._count += 1

    def percentile_ns(self, percent: float) -> int:
        """Return the percentile ``percent`` (0 to 100) of the differences, in ns; 0 if there are no frames."""
        rest = self._count * percent / 100
        for place in sorted(self._bins):
            rest -= self._bins[place]
            if rest <= 0:
                return min(round(math.exp(place / 20) - 1), self.max_ns)
        return self.max_ns


@dataclass(slots=True)
class SourceDifference:
    """The differences between two recordings of one source."""

    source: str
    frames: Side = field(default_factory=Side)
    events: Side = field(default_factory=Side)
    registers: dict[str, RegisterDifference] = field(default_factory=dict)
    fields: dict[str, int] = field(default_factory=dict)
    """Number of frames that differ in a field, by field: quality, reason, source time."""
    missing: list[str] = field(default_factory=list)
    """Registers that only one recording has."""
    timing: Timing = field(default_factory=Timing)

    @property
    def same(self) -> bool:
        """True if no difference was found in this source."""
        return self.frames.same and self.events.same and not self.missing


IGNORABLE: Final = ("times", "cycle", "reason", "events", "ends")
"""The kinds of differences that a comparison can ignore.

``ends`` stands for the frames and events that only one recording has, before the first or after the
last frame or event that both recordings have.
"""
_OF_PROCESSES: Final = frozenset({EventKind.STARTED, EventKind.STOPPED})


_Chosen = tuple[Mapping[DumpBlock, Sequence[Register]], Mapping[DumpBlock, Sequence[Register]]]


@dataclass(frozen=True, slots=True)
class Comparison:
    """The options of a comparison.

    Attributes:
        ignore: The differences to ignore, from :data:`IGNORABLE`.
        only: Paths of the registers to compare, as for :meth:`Dump.select`; empty for all.
        tolerance: Absolute difference up to which REAL and LREAL values count as equal.
        relative: Difference up to which they count as equal, as a fraction of the larger absolute
            value.
    """

    ignore: Collection[str] = ()
    only: Collection[str] = ()
    tolerance: float = 0.0
    relative: float = 0.0


def compare(
    first: Dump,
    second: Dump,
    how: Comparison,
    sources: Collection[str] | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> Iterator[SourceDifference]:
    """Compare two recordings source by source.

    A frame of the first recording is compared with the frame of the second that has the same cycle.
    If cycles are ignored, it is compared with the frame that has the same source time; if times are
    also ignored, with the next frame.

    Args:
        first: The first recording.
        second: The second recording.
        how: The options.
        sources: Names of the sources to compare; None for all.
        progress: Called with the log time that the comparison has reached in the first recording.

    Yields:
        The differences of each source.

    Raises:
        PathError: A source or register is in neither recording.
    """
    names = list(dict.fromkeys((*first.sources, *second.sources)))
    chosen = _chosen(first, how), _chosen(second, how)
    if how.only:
        names = [name for name in names if any(block.source == name for some in chosen for block in some)]
    if sources is not None:
        for source in sources:
            if source not in names:
                raise PathError(unknown("source", source, names))
        names = list(sources)
    for name in names:
        yield _Source(first, second, name, how, chosen, progress).compare()


def _chosen(dump: Dump, how: Comparison) -> Mapping[DumpBlock, Sequence[Register]]:
    """Return the registers to compare in each block, and their statuses if the source gave any."""
    registers = dump.select(how.only) if how.only else {block: block.layout.registers for block in dump.blocks}
    return {block: (*some, *status_registers(block.layout, some, times=False)) for block, some in registers.items()}


class _Source:
    def __init__(
        self, first: Dump, second: Dump, name: str, how: Comparison, chosen: _Chosen, progress: Callable[[int], object]
    ) -> None:
        self._dumps = first, second
        self._chosen = chosen
        self._name = name
        self._how = how
        self._progress = progress
        self._found = SourceDifference(name)
        self._pairs: dict[tuple[DumpBlock, DumpBlock], _Registers] = {}
        self._common = _Common()

    def compare(self) -> SourceDifference:
        found = self._found
        ignore = self._how.ignore
        frames = [groupby(_frames(dump, self._name), self._frame_key) for dump in self._dumps]
        in_order = _InOrder(shifted="ends" in ignore and not {"cycle", "times"} <= {*ignore})
        self._compare(found.frames, _joined(frames[0], frames[1], in_order), self._frames)
        if "events" not in ignore:
            events = [_grouped(_events(dump, self._name), self._event_key, MAX_EVENTS) for dump in self._dumps]
            self._compare(found.events, _joined(events[0], events[1], _aligned), self._events)
        found.missing = sorted({path for pair in self._pairs.values() for path in pair.missing})
        return found

    def _frame_key(self, entry: Entry[Frame]) -> int:
        if "cycle" not in self._how.ignore:
            return entry.item.cycle
        return 0 if "times" in self._how.ignore else entry.item.source_ns

    def _event_key(self, entry: Entry[Event]) -> int:
        if "cycle" not in self._how.ignore:
            return entry.item.cycle
        if "times" not in self._how.ignore:
            return entry.item.utc_ns
        return entry.item.frame - (entry.block.after.get("frames", 0) if entry.block else 0)

    def _compare(
        self, side: Side, pairs: Iterator[_Pair[T]], differs: Callable[[Entry[T], Entry[T]], list[str]]
    ) -> None:
        since, inside = _Alone(), _Alone()
        begun = False
        for one, other in pairs:
            if one is None or other is None:
                if "ends" in self._how.ignore and self._common.begins_after(one, other):
                    continue
                since.add(one, other)
                if self._common.has(one, other):
                    inside.add(one, other)
                continue
            self._alone(side, since if begun else self._of_end(since, inside))
            since, inside, begun = _Alone(), _Alone(), True
            side.compared += 1
            if what := differs(one, other):
                side.differing += 1
                self._first(side, one, other, what)
            self._common.add(one, other)
            self._progress(one.time_ns)
        self._alone(side, self._of_end(since, inside))

    def _of_end(self, since: _Alone, inside: _Alone) -> _Alone:
        """Return the unmatched entries at one end of the recordings that count as differences.

        Args:
            since: All entries at this end that only one recording has.
            inside: The entries of ``since`` between the first and the last common entry. If ends
                are ignored, only these count.
        """
        return inside if "ends" in self._how.ignore else since

    def _alone(self, side: Side, alone: _Alone) -> None:
        if alone.first is not None:
            side.only_first += alone.counts[0]
            side.only_second += alone.counts[1]
            one, other = alone.first
            self._first(side, one, other, ["only in the first" if other is None else "only in the second"])

    def _first(self, side: Side, one: Entry[Any] | None, other: Entry[Any] | None, what: list[str]) -> None:
        if side.first is None:
            side.first = Difference(
                (one and one.time_ns, other and other.time_ns),
                (one and one.item.number, other and other.item.number),
                what,
            )

    # ---- frames ------------------------------------------------------------------------------------------------------

    def _frames(self, one: Entry[Frame], other: Entry[Frame]) -> list[str]:
        a, b, ignore = one.item, other.item, self._how.ignore
        self._found.timing.add(one.time_ns, other.time_ns)
        what = []
        if a.quality is not b.quality:
            what.append(self._field("quality", a.quality, b.quality))
        if a.reason != b.reason and "reason" not in ignore:
            what.append(self._field("reason", a.reason, b.reason))
        if a.source_ns != b.source_ns and "times" not in ignore:
            what.append(self._field("source time", a.source_ns, b.source_ns))
        registers = self._registers(one.block, other.block)
        if registers is not None:
            for path, values in registers.differing(a, b):
                what.append(f"{path}: {values[0]} -> {values[1]}")
                self._register(path, (one.time_ns, other.time_ns), values)
        return what

    def _registers(self, one: DumpBlock | None, other: DumpBlock | None) -> _Registers | None:
        """Return the registers of two blocks to compare; None if a block is not selected."""
        if one is None or other is None or one not in self._chosen[0] or other not in self._chosen[1]:
            return None
        if (one, other) not in self._pairs:
            self._pairs[one, other] = _Registers((one, other), self._how, self._chosen)
        return self._pairs[one, other]

    def _field(self, name: str, one: object, other: object) -> str:
        self._found.fields[name] = self._found.fields.get(name, 0) + 1
        return f"{name}: {one!s} -> {other!s}"

    def _register(self, path: str, times_ns: tuple[int, int], values: tuple[Value, Value]) -> None:
        found = self._found.registers.get(path)
        if found is None:
            found = self._found.registers[path] = RegisterDifference(0, times_ns, values)
        found.count += 1
        if all(isinstance(value, int | float) for value in values):
            found.largest = max(found.largest, abs(float(values[0]) - float(values[1])))  # type: ignore[arg-type]

    # ---- events ------------------------------------------------------------------------------------------------------

    def _events(self, one: Entry[Event], other: Entry[Event]) -> list[str]:
        return [
            f"{name}: {getattr(one.item, name)!s} -> {getattr(other.item, name)!s}"
            for name in EVENT_FIELDS
            if getattr(one.item, name) != getattr(other.item, name)
        ]


class _Alone:
    """Counts the entries that only one recording has, and stores the first such entry."""

    def __init__(self) -> None:
        self.counts = [0, 0]
        self.first: tuple[Entry[Any] | None, Entry[Any] | None] | None = None

    def add(self, one: Entry[Any] | None, other: Entry[Any] | None) -> None:
        self.counts[one is None] += 1
        self.first = self.first or (one, other)


class _Common:
    """The range, in each recording, from the first to the last entry that both recordings have."""

    def __init__(self) -> None:
        self._ends: list[tuple[_Position, _Position]] = []

    def add(self, one: Entry[Any], other: Entry[Any]) -> None:
        both = _position(one), _position(other)
        ends = self._ends or [(position, position) for position in both]
        self._ends = [
            (min(first, position), max(last, position)) for (first, last), position in zip(ends, both, strict=True)
        ]

    def begins_after(self, one: Entry[Any] | None, other: Entry[Any] | None) -> bool:
        """Return whether an entry of only one recording comes before the first common entry."""
        return bool(self._ends) and any(
            entry is not None and _position(entry) < first
            for entry, (first, _) in zip((one, other), self._ends, strict=True)
        )

    def has(self, one: Entry[Any] | None, other: Entry[Any] | None) -> bool:
        """Return whether an entry that only one recording has lies within this range."""
        return bool(self._ends) and all(
            entry is None or first <= _position(entry) <= last
            for entry, (first, last) in zip((one, other), self._ends, strict=True)
        )


_Position = tuple[int, int, bool]


def _position(entry: Entry[Any]) -> _Position:
    """Return the position of an entry by time and number. Times are equal while time is paused."""
    item = entry.item
    return (entry.time_ns, item.frame, True) if isinstance(item, Event) else (entry.time_ns, item.number, False)


class _Registers:
    """Compares the registers that two blocks have in common."""

    def __init__(self, blocks: tuple[DumpBlock, DumpBlock], how: Comparison, chosen: _Chosen) -> None:
        first, second = blocks
        ones, others = (
            {register.path: register for register in some[block]} for block, some in zip(blocks, chosen, strict=True)
        )
        both = [path for path in ones if path in others and _kind(ones[path]) == _kind(others[path])]
        self.missing = sorted((ones.keys() | others.keys()) - set(both))
        self._layouts = first.layout, second.layout
        alike = first.layout.size == second.layout.size and first.layout.byte_order == second.layout.byte_order
        alike = alike and all(ones[path].offset == others[path].offset for path in both)
        self._all = _Places([(ones[path], others[path]) for path in both], self._layouts, how, alike=alike)
        self._of_array: dict[str, _Places] = {}

    def differing(self, one: Frame, other: Frame) -> Iterator[tuple[str, tuple[Value, Value]]]:
        """Yield the path and both values of each register or array element that differs.

        The values are those that readers saw. If these are equal, compare the values that the
        source delivered, without injections.
        """
        seen = set()
        for path, values in self._images(one.image, other.image):
            seen.add(path)
            yield path, values
        if one.effective is not None or other.effective is not None:
            for path, values in self._images(one.raw, other.raw):
                if path not in seen:
                    yield path, values

    def _images(self, one: bytes, other: bytes) -> Iterator[tuple[str, tuple[Value, Value]]]:
        for pair, values in self._all.differing(one, other):
            if not pair[0].dims:
                yield pair[0].path, values
                continue
            for element, (a, b) in self._elements(pair).differing(one, other):
                yield element[0].path, (a, b)

    def _elements(self, pair: tuple[Register, Register]) -> _Places:
        path = pair[0].path
        if path not in self._of_array:
            both = (elements(layout, register) for layout, register in zip(self._layouts, pair, strict=True))
            self._of_array[path] = self._all.like(list(zip(*both, strict=True)))
        return self._of_array[path]


class _Places:
    """Compares registers or array elements whose offsets in two layouts may differ."""

    def __init__(
        self,
        pairs: Sequence[tuple[Register, Register]],
        layouts: tuple[Layout, Layout],
        how: Comparison,
        *,
        alike: bool,
    ) -> None:
        """Create the comparison for pairs of registers.

        Set ``alike`` if both layouts have these registers at the same offsets. The comparison is
        then faster, because it compares bytes first.
        """
        self._pairs = pairs
        self._how = how
        self._layouts = layouts
        self._tolerant = how.tolerance > 0 or how.relative > 0
        self._codecs = [
            (codec(one, layouts[0].byte_order), codec(other, layouts[1].byte_order)) for one, other in pairs
        ]
        self._scan = ChangeScan([one for one, _ in pairs]) if alike else None

    def like(self, pairs: Sequence[tuple[Register, Register]]) -> _Places:
        """Return a comparison of other registers of the same layouts."""
        return _Places(pairs, self._layouts, self._how, alike=self._scan is not None)

    def differing(self, one: bytes, other: bytes) -> Iterator[tuple[tuple[Register, Register], tuple[Value, Value]]]:
        """Yield each pair of registers that differs in two images, with both values."""
        if self._scan is not None and one == other:
            return
        places = range(len(self._pairs)) if self._scan is None else self._scan.changed(one, other)
        for place in places:
            codec_of_one, codec_of_other = self._codecs[place]
            values = codec_of_one.decode(one), codec_of_other.decode(other)
            if self._scan is None and values[0] == values[1]:
                continue
            real = self._pairs[place][0].element.base in ("REAL", "LREAL")
            if real and (self._scan is None or self._tolerant) and _alike(*values, self._how):
                continue
            yield self._pairs[place], values


def _alike(one: Value, other: Value, how: Comparison) -> bool:
    """Return whether two REAL or LREAL values, or arrays, are equal within the tolerance."""
    if isinstance(one, list) and isinstance(other, list):
        return all(_alike(a, b, how) for a, b in zip(one, other, strict=True))
    if not isinstance(one, float) or not isinstance(other, float):
        return False
    if math.isnan(one) or math.isnan(other):
        return math.isnan(one) and math.isnan(other)
    return math.isclose(one, other, rel_tol=how.relative, abs_tol=how.tolerance)


def _kind(register: Register) -> tuple[str, object]:
    return register.type, register.dims


def _frames(dump: Dump, source: str) -> Iterator[Entry[Frame]]:
    """Yield the frames of a source, except the bad frames that a replay has added."""
    if source in dump.sources:
        for entry in dump.frames(source):
            if entry.item.provenance is not Provenance.REPLAYED or not entry.item.reason.startswith(OWN_WORDS):
                yield entry


def _events(dump: Dump, source: str) -> Iterator[Entry[Event]]:
    """Yield the events of a source, except events about its process or about a replay."""
    if source in dump.sources:
        for entry in dump.events(source):
            if entry.item.kind not in _OF_PROCESSES and not _is_replays(entry.item):
                yield entry


def _is_replays(event: Event) -> bool:
    return event.kind == EventKind.QUALITY and event.text.startswith(OWN_WORDS)


# ---- matching entries of two recordings ------------------------------------------------------------------------------


def _grouped(entries: Iterable[Entry[T]], key: Callable[[Entry[T]], int], most: int) -> _Groups[T]:
    """Yield groups of consecutive entries with the same key, each of at most ``most`` entries."""
    for value, some in groupby(entries, key):
        while group := list(islice(some, most)):
            yield value, group


def _joined(
    first: _Groups[T],
    second: _Groups[T],
    align: Callable[[Iterable[Entry[T]], Iterable[Entry[T]]], Iterable[_Pair[T]]],
) -> Iterator[_Pair[T]]:
    """Yield pairs of matching entries.

    If one recording lacks an entry, its place in the pair is None.

    The keys of both recordings must ascend. ``align`` matches the entries of two groups that have
    the same key.
    """
    one, other = next(first, None), next(second, None)
    while one is not None or other is not None:
        if one is not None and (other is None or one[0] < other[0]):
            yield from ((entry, None) for entry in one[1])
            one = next(first, None)
        elif other is not None and (one is None or one[0] > other[0]):
            yield from ((None, entry) for entry in other[1])
            other = next(second, None)
        elif one is not None and other is not None:
            yield from align(one[1], other[1])
            one, other = next(first, None), next(second, None)


class _InOrder:
    """Pairs the frames of two groups in order: the first with the first, and so on.

    If ``shifted`` is True, one recording may lack the first frames of its first group. For these
    groups, an offset is chosen for which most pairs have the same content.
    """

    def __init__(self, *, shifted: bool) -> None:
        self._shifted = shifted

    def __call__(self, ones: Iterable[Entry[Frame]], others: Iterable[Entry[Frame]]) -> Iterator[_Pair[Frame]]:
        """Yield the pairs. If one group lacks a frame, its place in the pair is None."""
        if self._shifted:
            self._shifted = False
            first, second = iter(ones), iter(others)
            left, right = list(islice(first, MAX_SHIFT)), list(islice(second, MAX_SHIFT))
            shift = _shift(left, right)
            yield from ((entry, None) for entry in left[: max(0, shift)])
            yield from ((None, entry) for entry in right[: max(0, -shift)])
            ones, others = chain(left[max(0, shift) :], first), chain(right[max(0, -shift) :], second)
        yield from zip_longest(ones, others)


def _shift(ones: Sequence[Entry[Frame]], others: Sequence[Entry[Frame]]) -> int:
    """Return the offset between two groups: how many entries of ``ones`` precede ``others``.

    The offset is negative if ``others`` begin earlier. With this offset, most pairs have the same
    content. Of several such offsets, return the offset with the most pairs, and then the largest.
    """

    def alike(shift: int) -> tuple[int, int, int]:
        pairs = list(zip(ones[max(0, shift) :], others[max(0, -shift) :], strict=False))
        return sum(_image(one.item) == _image(other.item) for one, other in pairs), len(pairs), abs(shift)

    return max(range(1 - len(others), len(ones)), key=alike)


def _image(frame: Frame) -> Hashable:
    return frame.quality, frame.raw, frame.effective


def _aligned(ones: Iterable[Entry[Event]], others: Iterable[Entry[Event]]) -> Iterator[_Pair[Event]]:
    """Pair events in any order: first by equal content, then by kind and offset, then by kind."""
    left: list[Entry[Event]] = list(ones)
    right: list[Entry[Event]] = list(others)
    for alike in (_content, _place, _event_kind):
        waiting: defaultdict[Hashable, deque[Entry[Event]]] = defaultdict(deque)
        for entry in right:
            waiting[alike(entry.item)].append(entry)
        unmatched = []
        matched = set()
        for entry in left:
            if same := waiting[alike(entry.item)]:
                matched.add(id(same[0]))
                yield entry, same.popleft()
            else:
                unmatched.append(entry)
        left, right = unmatched, [entry for entry in right if id(entry) not in matched]
    yield from ((entry, None) for entry in left)
    yield from ((None, entry) for entry in right)


def _content(event: Event) -> Hashable:
    return tuple(getattr(event, name) for name in EVENT_FIELDS)


def _place(event: Event) -> Hashable:
    return event.kind, event.offset, event.mask


def _event_kind(event: Event) -> Hashable:
    return event.kind
