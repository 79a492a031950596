"""Explain events: find the registers, values, direction and writer that they are about.

Import this module only when you need it: it imports numpy, which takes time.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from shmio.layout.model import Layout, Register
from shmio.layout.topic import find
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.text import json_value, to_text
from shmio.layout.values.write import Write, bits_of, paths_of
from shmio.layout.values.write import apply as write_to
from shmio.model.injection import Injection
from shmio.model.values import NO_WRITER, ROLES
from shmio.segment.events import EVENT_DATA_SIZE, Event, EventKind
from shmio.segment.processes import EXTERNAL_SLOTS

MAX_REMEMBERED: Final = 4096
"""An explainer remembers at most this many unfinished commands and this many injections."""
MAX_DEFINITION_BYTES: Final = 1 << 16

_INWARD: Final = frozenset(
    {
        EventKind.ACCEPTED,
        EventKind.WRITTEN,
        EventKind.REFUSED,
        EventKind.EXPIRED,
        EventKind.UNKNOWN,
        EventKind.TAKEN,
        EventKind.REJECTED,
    }
)
"""Kinds of events that are about writes to the device, even if an injection took the write."""
_WITH_VALUES: Final = frozenset({EventKind.ACCEPTED, EventKind.DIVERTED, EventKind.SHADOWED})
_OF_WRITES: Final = frozenset({*_INWARD, EventKind.DIVERTED, EventKind.SHADOWED})
_OF_INJECTIONS: Final = frozenset(
    {EventKind.INJECTED, EventKind.LIFTED, EventKind.ACTIVATED, EventKind.DEACTIVATED, EventKind.DIVERTED}
)


class Place(NamedTuple):
    """A register or a part of a register, with its full path.

    ``valued`` is True if ``value`` is known.
    """

    path: str
    register: Register
    value: Value = None
    valued: bool = False

    @property
    def text(self) -> str:
        """The value as text for users."""
        return to_text(self.value, self.register)

    @property
    def plain(self) -> Any:
        """The value in a form that JSON can encode."""
        return json_value(self.value, self.register.element)


class Explained(NamedTuple):
    """Explanation of an event.

    Attributes:
        places: The registers that the event concerns.
        direction: ``in``: data for the device; ``out``: data for consumers; empty: unknown or
            neither.
        by: The client that caused the event, such as ``web: anonymous (127.0.0.1)``. If the event does
            not say who it was: the owner of the command queue, such as ``grpc``, ``mqtt`` or
            ``program 1``. Empty: no client caused it, or the client is unknown.
        definition: Definition of a new injection. If the definition takes several events, only the
            last of them has it.
        partial: True if the event has a part of a definition, and events with further parts follow.
    """

    places: tuple[Place, ...]
    direction: str
    by: str
    definition: dict[str, Any] | None
    partial: bool = False


class _Injection(NamedTuple):
    direction: str
    places: tuple[Place, ...]
    by: str = ""


class Explainer:
    """Explains the events of one block.

    Pass the events in order, because an event may refer to earlier events.
    """

    def __init__(self, source: str, layout: Layout | None, most: int | None = None) -> None:
        """Start without known injections.

        Args:
            source: Name of the source.
            layout: The block's layout; None if it cannot be read, so that no registers are named.
            most: Maximum number of registers to name for an event; None: all.
        """
        self._source = source
        self._layout = layout
        self._most = most
        self._injections: dict[int, _Injection] = {}
        self._documents: dict[int, bytes] = {}
        self._in_flight: dict[tuple[int, int, int], dict[int, list[Place]]] = {}
        self._gone: frozenset[int] = frozenset()
        """Injections that ended before event ``_gone_at`` or with it."""
        self._gone_at = 0

    def know(self, present: Iterable[Injection[Any]]) -> None:
        """Remember existing injections, so that later events about them can be explained."""
        for one in present:
            if one.number not in self._injections and len(self._injections) < MAX_REMEMBERED:
                # Events of declared injections name no registers, so give them none here.
                places = self._over(one.ranges) if one.running is None else ()
                self._injections[one.number] = _Injection(one.direction, places)

    def resume(self, present: Sequence[Injection[Any]], newest: int) -> None:
        """Continue after events were lost, which may have been the ends of commands or injections.

        Args:
            present: The injections that exist now.
            newest: Number of the newest event, determined after ``present`` was read.
        """
        self._in_flight.clear()
        self._documents.clear()
        self._gone = frozenset(self._injections) - {one.number for one in present}
        self._gone_at = newest
        self.know(present)

    def explain(self, event: Event) -> Explained:
        """Explain the next event."""
        if self._gone and event.number > self._gone_at:  # their LIFTED events were explained or lost
            for number in self._gone:
                self._injections.pop(number, None)
            self._gone = frozenset()
        if event.kind == EventKind.STARTED:  # commands to the old process get no more events
            for key in [key for key in self._in_flight if key[0] != event.incarnation]:
                del self._in_flight[key]
        definition = self._definition(event) if event.kind == EventKind.INJECTED else None
        known = self._injections.get(event.injection)
        direction, places = "", tuple[Place, ...]()
        if event.kind in _OF_INJECTIONS:
            direction = known.direction if known else ""
        elif event.kind in _INWARD and event.size:  # without a size, the event is not about a write
            direction = "in"
        elif event.kind == EventKind.SHADOWED:  # values over /in have the events of writes instead
            direction = "out"
        if event.kind in _OF_WRITES:
            places = self._of_command(event)
        elif known is not None and event.kind in _OF_INJECTIONS:
            places = known.places
        if event.kind == EventKind.LIFTED:
            self._injections.pop(event.injection, None)
            self._documents.pop(event.injection, None)
        partial = event.kind == EventKind.INJECTED and definition is None and len(event.data) == EVENT_DATA_SIZE
        who = event.by or (known.by if known is not None and event.command == event.injection else "")
        return Explained(places, direction, who or by(event.writer), definition, partial)

    def _of_command(self, event: Event) -> tuple[Place, ...]:
        """Return the registers that the event's items write.

        An event that ends several items at once has no data. The registers are then those of the
        items' ACCEPTED events.
        """
        if event.kind in _WITH_VALUES:
            places = self._places(event.offset, len(event.data), event.mask, event.data)
            if event.kind == EventKind.ACCEPTED:
                self._remember(event, places)
            return places
        key = event.command_key
        accepted = self._in_flight.get(key, {})
        found: list[Place] = []
        for item in range(event.item, event.item + min(event.items, MAX_REMEMBERED)):
            found += self._at_most(accepted.pop(item, ()), found)
        if not accepted:
            self._in_flight.pop(key, None)
        return tuple(found) or self._places(event.offset, event.size, event.mask)

    def _remember(self, event: Event, places: tuple[Place, ...]) -> None:
        if len(self._in_flight) >= MAX_REMEMBERED:
            self._in_flight.pop(next(iter(self._in_flight)))
        items = self._in_flight.setdefault(event.command_key, {})
        if len(items) < MAX_REMEMBERED:
            known = items.setdefault(event.item, [])
            known += (place._replace(value=None, valued=False) for place in self._at_most(places, known))

    def _at_most(self, places: Sequence[Place], before: Sequence[Place]) -> Sequence[Place]:
        """Return the first of ``places``; together with ``before``, at most the maximum number."""
        return places if self._most is None else places[: self._most - len(before)]

    def _places(self, offset: int, size: int, mask: int, data: bytes = b"") -> tuple[Place, ...]:
        if self._layout is None or offset + size > self._layout.size:
            return ()
        found = self._named([Write(offset, mask, b"\xff" * size)])
        if not data:
            return found
        image, bits = bytearray(self._layout.size), bytearray(self._layout.size)
        write_to(Write(offset, mask, data), image)
        write_to(Write(offset, mask, b"\xff" * size), bits)
        order = self._layout.byte_order
        return tuple(
            place._replace(value=codec(place.register, order).decode(image), valued=True)
            if _is_whole(place.register, bits)
            else place
            for place in found
        )

    def _named(self, writes: Iterable[Write]) -> tuple[Place, ...]:
        if self._layout is None:
            return ()
        paths = paths_of(self._layout, writes, self._most)
        return tuple(Place(f"{self._source}/{path}", find(self._layout, path)) for path in paths)

    # ---- injections --------------------------------------------------------------------------------------------------

    def _definition(self, event: Event) -> dict[str, Any] | None:
        """Add an event's part to the definition of an injection; return the complete definition.

        Return None while parts are missing. When the definition is complete, remember which
        registers the injection covers.
        """
        document = (self._documents.pop(event.injection, b"") if event.offset else b"") + event.data
        try:
            definition = msgspec.json.decode(document, type=dict[str, Any])
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            if document and len(document) < MAX_DEFINITION_BYTES and len(self._documents) < MAX_REMEMBERED:
                self._documents[event.injection] = document
            return None
        if len(self._injections) >= MAX_REMEMBERED:
            self._injections.pop(next(iter(self._injections)))
        if "ranges" in definition:
            self._injections[event.injection] = _Injection(
                str(definition.get("direction", "")), self._over(definition.pop("ranges")), event.by
            )
        else:
            target = definition.get("target", "")
            targets = [str(one) for one in target] if isinstance(target, list) else [str(target)]
            inward = any(one.endswith("/in") for one in targets)
            self._injections[event.injection] = _Injection("in" if inward else "out", (), event.by)
        return definition

    def _over(self, ranges: object) -> tuple[Place, ...]:
        """Return the registers that ranges cover; a range is (offset, size, bits of each byte)."""
        try:
            parts = msgspec.convert(ranges, list[tuple[int, int, int]])
        except msgspec.ValidationError:
            return ()
        most = self._layout.size if self._layout else 0
        return self._named(
            Write(offset, bits, b"\xff" * min(size, most)) for offset, size, bits in parts if 0 <= offset < most
        )


def _is_whole(register: Register, bits: bytearray) -> bool:
    """Return whether all bits of a register are set in ``bits``."""
    there = bits[register.offset : register.offset + register.size]
    return all(own & bit == own for own, bit in zip(bits_of(register), there, strict=True))


def by(writer: int) -> str:
    """Return the name of the endpoint or program that owns a command queue; empty if there is none."""
    if writer == NO_WRITER:
        return ""
    return ROLES.get(writer, f"program {writer + 1}" if writer < EXTERNAL_SLOTS else f"writer {writer}")


ABOUT: Final = ("path", "value", "direction", "by")
"""Headings of the cells that :func:`cells_of` returns."""


def kind_of(event: Event) -> str:
    """Return the name of an event's kind; ``kind N`` if this version of shmio does not know it."""
    try:
        return str(EventKind(event.kind))
    except ValueError:  # of a later version
        return f"kind {event.kind}"


def object_of(event: Event, explained: Explained) -> dict[str, Any]:
    """Return what an event is about, as a JSON object; its ``data`` is in hexadecimal digits."""
    places = explained.places
    return {
        "by": explained.by,
        "direction": explained.direction,
        "paths": [place.path for place in places],
        "values": {place.path: place.plain for place in places if place.valued},
        "laid": explained.definition,
        "injection": event.injection,
        **{name: getattr(event, name) for name in ("command", "item", "items", "offset", "mask", "size", "text")},
        "data": event.data.hex(),
    }


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def cells_of(explained: Explained, dumps: Callable[[Any], str] = _json) -> tuple[str, ...]:
    """Return what an event is about, as cells of a table with the columns of ``ABOUT``.

    If the event concerns several registers, the cell with the value is a JSON object of all values
    by path, which ``dumps`` encodes.
    """
    places = explained.places
    valued = [place for place in places if place.valued]
    value = dumps({place.path: place.plain for place in valued}) if valued[1:] else "".join(p.text for p in valued)
    return ", ".join(place.path for place in places), value, explained.direction, explained.by
