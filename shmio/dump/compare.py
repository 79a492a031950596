"""What two recordings have in common, and where they differ: frame by frame, event by event."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from shmio.dump.blocks import DumpBlock
from shmio.dump.differences import Difference, RegisterDifference, Side, SourceDifference
from shmio.dump.dump import Dump
from shmio.dump.entries import Entry
from shmio.errors import PathError
from shmio.layout.codec import Value, codec
from shmio.layout.model import Register
from shmio.segment import Event, EventKind, Frame, Provenance
from shmio.segment.playhead import OWN_WORDS
from shmio.segment.scan import ChangeScan

IGNORABLE: Final = ("times", "cycle", "reason", "events", "ends")
"""``ends``: what one of the two has before the first frame or event of both, or after the last."""
_OF_PROCESSES: Final = frozenset({EventKind.STARTED, EventKind.STOPPED})
_EVENT_FIELDS: Final = ("kind", "quality", "text", "offset", "size", "mask", "data")

T = TypeVar("T", Frame, Event)
_Chosen = tuple[Mapping[DumpBlock, Sequence[Register]], Mapping[DumpBlock, Sequence[Register]]]


@dataclass(frozen=True, slots=True)
class Comparison:
    """What is compared: ``ignore`` of :data:`IGNORABLE`; ``only`` as of :meth:`Dump.select`, none for all.

    REAL and LREAL are the same within ``tolerance`` or, relative to the larger one, ``relative``.
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
    """Source by source. ``progress`` is told log times of the first. PathError: no such source, or register, in either.

    Frames belong together that have the same cycle; where that is ignored, the same source time; else in their order.
    """
    names = list(dict.fromkeys((*first.sources, *second.sources)))
    chosen = _chosen(first, how), _chosen(second, how)
    if how.only:
        names = [name for name in names if any(block.source == name for some in chosen for block in some)]
    if sources is not None:
        unknown = [source for source in sources if source not in names]
        if unknown:
            raise PathError(f"no source {unknown[0]!r} in them; there are: {', '.join(names)}")
        names = list(sources)
    for name in names:
        yield _Source(first, second, name, how, chosen, progress).compare()


def _chosen(dump: Dump, how: Comparison) -> Mapping[DumpBlock, Sequence[Register]]:
    return dump.select(how.only) if how.only else {block: block.layout.registers for block in dump.blocks}


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

    def compare(self) -> SourceDifference:
        found = self._found
        frames = [_frames(dump, self._name) for dump in self._dumps]
        self._join(found.frames, frames[0], frames[1], self._frame_key(), self._frames)
        if "events" not in self._how.ignore:
            events = [_events(dump, self._name) for dump in self._dumps]
            self._join(found.events, events[0], events[1], None, self._events)
        found.missing = sorted({path for pair in self._pairs.values() for path in pair.missing})
        return found

    def _frame_key(self) -> Callable[[Frame], int] | None:
        if "cycle" not in self._how.ignore:
            return lambda frame: frame.cycle
        if "times" not in self._how.ignore:
            return lambda frame: frame.source_ns
        return None

    def _join(
        self,
        side: Side,
        first: Iterator[Entry[T]],
        second: Iterator[Entry[T]],
        key: Callable[[T], int] | None,
        differs: Callable[[Entry[T], Entry[T]], list[str]],
    ) -> None:
        one, other = next(first, None), next(second, None)
        waiting: list[tuple[Entry[T] | None, Entry[T] | None]] = []
        counts = [0, 0]
        """What one of the two alone has since both had the same: an end, if nothing of both follows."""
        begun = False
        while one is not None or other is not None:
            order = 0
            if one is None or other is None:
                order = 1 if one is None else -1
            elif key is not None:
                order = (key(one.item) > key(other.item)) - (key(one.item) < key(other.item))
            if order:
                alone = (one, None) if order < 0 else (None, other)
                counts[order > 0] += 1
                waiting = waiting or [alone]
            if order == 0 and one is not None and other is not None:
                self._alone(side, waiting, counts, end=not begun)
                waiting, counts, begun = [], [0, 0], True
                side.compared += 1
                if what := differs(one, other):
                    side.differing += 1
                    self._first(side, one, other, what)
                self._progress(one.time_ns)
            one = next(first, None) if order <= 0 else one
            other = next(second, None) if order >= 0 else other
        self._alone(side, waiting, counts, end=True)

    def _alone(self, side: Side, waiting: list[Any], counts: list[int], *, end: bool) -> None:
        if not waiting or (end and "ends" in self._how.ignore):
            return
        side.only_first += counts[0]
        side.only_second += counts[1]
        one, other = waiting[0]
        self._first(side, one, other, ["only in the first" if other is None else "only in the second"])

    def _first(self, side: Side, one: Entry[T] | None, other: Entry[T] | None, what: list[str]) -> None:
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
                what.append(f"{path}: {values[0]} and {values[1]}")
                self._register(path, (one.time_ns, other.time_ns), values)
        return what

    def _registers(self, one: DumpBlock | None, other: DumpBlock | None) -> _Registers | None:
        """What to compare of two blocks; None: nothing of one of them was asked for."""
        if one is None or other is None or one not in self._chosen[0] or other not in self._chosen[1]:
            return None
        if (one, other) not in self._pairs:
            self._pairs[one, other] = _Registers((one, other), self._how, self._chosen)
        return self._pairs[one, other]

    def _field(self, name: str, one: object, other: object) -> str:
        self._found.fields[name] = self._found.fields.get(name, 0) + 1
        return f"{name}: {one!s} and {other!s}"

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
            f"{name}: {getattr(one.item, name)!s} and {getattr(other.item, name)!s}"
            for name in _EVENT_FIELDS
            if getattr(one.item, name) != getattr(other.item, name)
        ]


class _Registers:
    """The registers that two blocks have in common."""

    def __init__(self, blocks: tuple[DumpBlock, DumpBlock], how: Comparison, chosen: _Chosen) -> None:
        first, second = blocks
        ones, others = (
            {register.path: register for register in some[block]} for block, some in zip(blocks, chosen, strict=True)
        )
        both = [path for path in ones if path in others and _kind(ones[path]) == _kind(others[path])]
        self.missing = sorted((ones.keys() | others.keys()) - set(both))
        self._how = how
        self._tolerant = how.tolerance > 0 or how.relative > 0
        self._paths = both
        orders = first.layout.byte_order, second.layout.byte_order
        self._codecs = [(codec(ones[path], orders[0]), codec(others[path], orders[1])) for path in both]
        self._real = [ones[path].element.base in ("REAL", "LREAL") for path in both]
        alike = first.layout.size == second.layout.size and orders[0] == orders[1]
        self._scan = None
        if alike and all(ones[path].offset == others[path].offset for path in both):
            self._scan = ChangeScan([ones[path] for path in both])

    def differing(self, one: Frame, other: Frame) -> Iterator[tuple[str, tuple[Value, Value]]]:
        """Paths and values; of what was delivered, if that alone differs."""
        seen = set()
        for path, values in self._images(one.image, other.image):
            seen.add(path)
            yield path, values
        if one.effective is not None or other.effective is not None:
            for path, values in self._images(one.raw, other.raw):
                if path not in seen:
                    yield path, values

    def _images(self, one: bytes, other: bytes) -> Iterator[tuple[str, tuple[Value, Value]]]:
        if self._scan is not None and one == other:
            return
        places = range(len(self._paths)) if self._scan is None else self._scan.changed(one, other)
        for place in places:
            codec_of_one, codec_of_other = self._codecs[place]
            values = codec_of_one.decode(one), codec_of_other.decode(other)
            if self._scan is None and values[0] == values[1]:
                continue
            if self._real[place] and (self._scan is None or self._tolerant) and _alike(*values, self._how):
                continue
            yield self._paths[place], values


def _alike(one: Value, other: Value, how: Comparison) -> bool:
    """Whether two values are the same within the tolerance for REAL and LREAL."""
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
    """Those of the source itself: what a replay says of its own is not."""
    if source in dump.sources:
        for entry in dump.frames(source):
            if entry.item.provenance is not Provenance.REPLAYED or not entry.item.reason.startswith(OWN_WORDS):
                yield entry


def _events(dump: Dump, source: str) -> Iterator[Entry[Event]]:
    """Those that are of the source itself: starts and ends of its process, and what a replay tells, are not."""
    if source in dump.sources:
        for entry in dump.events(source):
            if entry.item.kind not in _OF_PROCESSES and not _is_replays(entry.item):
                yield entry


def _is_replays(event: Event) -> bool:
    return event.kind == EventKind.QUALITY and event.text.startswith(OWN_WORDS)
