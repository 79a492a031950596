"""Looks ahead in a recording for the next change of a register, or the next event of a kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from shmio.connectors.replay.player import is_told
from shmio.connectors.replay.tape import Entry, Tape
from shmio.errors import PathError
from shmio.layout.topic import find, shorten
from shmio.layout.write import bits_of
from shmio.segment import Event, EventKind, Frame
from shmio.segment.playhead import Find, Found

ANY = "any"
"""In place of a kind: whatever event is told."""
PIECE = 256
"""So many entries between two looks at what else there is to do."""


class Search:
    """A search under way, in pieces, so that what plays meanwhile goes on."""

    def __init__(self, tape: Tape, find: Find, end_ns: int, *, keep: bool) -> None:
        """Up to before ``end_ns``. ``keep``: as consumers see the recording. PathError: no such register or kind."""
        self._end_ns = end_ns
        self._matches = _happened(find.event, keep=keep) if find.event else _changed(tape, find, keep=keep)
        self._entries: Iterator[Entry] = tape.entries(find.after_ns + 1)
        self._what = f"event {find.event}" if find.event else f"change of {find.path}"

    def go_on(self) -> Found | None:
        """Look a piece further; None: it is not over yet."""
        for _ in range(PIECE):
            entry = next(self._entries, None)
            if entry is None or entry.position_ns >= self._end_ns:
                return Found(f"there is no {self._what} from here to the end of what is played")
            if self._matches(entry):
                return Found(position_ns=entry.position_ns)
        return None


def _happened(name: str, *, keep: bool) -> Callable[[Entry], bool]:
    kinds = {str(kind): kind for kind in EventKind}
    if name == ANY:
        return lambda entry: isinstance(entry.item, Event) and is_told(entry.item, keep=keep)
    if name not in kinds:
        raise PathError(f"event {shorten(name, 16)!r} is none of {', '.join(kinds)}, {ANY}")
    return lambda entry: isinstance(entry.item, Event) and entry.item.kind == kinds[name]


def _changed(tape: Tape, wanted: Find, *, keep: bool) -> Callable[[Entry], bool]:
    register = find(tape.block.layout, wanted.path)
    span = slice(register.offset, register.offset + register.size)
    bits = bits_of(register)

    def value(frame: Frame) -> bytes:
        data = (frame.image if keep else frame.raw)[span]
        return bytes(byte & mask for byte, mask in zip(data, bits, strict=True))

    entry = tape.newest(wanted.after_ns)
    last = value(entry.item) if entry is not None and isinstance(entry.item, Frame) else None

    def matches(entry: Entry) -> bool:
        nonlocal last
        if not isinstance(entry.item, Frame):
            return False
        before, last = last, value(entry.item)
        return before is not None and last != before

    return matches
