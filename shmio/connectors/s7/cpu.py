"""Registers of a tag table whose values come from the CPU itself, such as its mode, clock and identity.

Their addresses are ``cpu.state``, ``cpu.clock``, ``cpu.order_code`` and the like. The session asks for
these values between reads. If the CPU refuses a question, only the registers that need its answer turn
bad. Siemens describes the lists and their records in System Software for S7-300/400, A5E00739858, 33.3,
33.5 and 33.21. Users of python-snap7 have found that record 7 of list 0x0011 contains the firmware on
S7-1200 and S7-1500, too (its ``szl.py``).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from shmio.connectors.register_image import RegisterImage
from shmio.connectors.s7.explain import ACCESS_DENIED, RefusedError, names_of
from shmio.connectors.s7.mode import MODES, ModeQuery
from shmio.connectors.s7.query import Query
from shmio.connectors.s7.userdata import READ_CLOCK, READ_SZL, Service, parse_clock, szl_data, szl_records
from shmio.layout.encodings import WINDOWS_1252, text_encoding
from shmio.layout.model import INTEGERS, Register, is_encoded
from shmio.layout.s7.address import CPU
from shmio.layout.values.codec import Value
from shmio.model.statuses import (
    BAD_NO_DATA,
    BAD_NOT_SUPPORTED,
    BAD_USER_ACCESS_DENIED,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
)
from shmio.wording import unknown

CLOCK_INTERVAL_NS: Final = 1_000_000_000
_MODULES, _COMPONENTS = 0x0011, 0x001C
_STATE, _CLOCK = "state", "clock"


class _Text(NamedTuple):
    """The place of a text in a system status list."""

    szl: int
    record: int
    start: int
    length: int


_TEXTS: Final[Mapping[str, _Text]] = {
    "order_code": _Text(_MODULES, 1, 2, 20),
    "firmware": _Text(_MODULES, 7, 24, 12),  # as text: V255.255.255
    "name": _Text(_COMPONENTS, 1, 2, 24),
    "module_name": _Text(_COMPONENTS, 2, 2, 24),
    "plant": _Text(_COMPONENTS, 3, 2, 32),
    "serial_number": _Text(_COMPONENTS, 5, 2, 24),
    "module_type": _Text(_COMPONENTS, 7, 2, 32),
}
_NAMES: Final = (_STATE, _CLOCK, *_TEXTS)
_TIMES: Final = ("DATE_AND_TIME", "DTL", "LDT")
_LONGEST_STATE: Final = 9
_CLOCK_LENGTH: Final = 23

log = logging.getLogger("shmio.source")


class CpuTag(NamedTuple):
    """A register of a tag table with a value of the CPU."""

    place: int
    """The register's index in the layout."""
    register: Register
    name: str
    """The address without ``cpu.``."""


def parse(place: int, register: Register) -> CpuTag:
    """Return the tag of a register that has an address such as ``cpu.clock``.

    Raises:
        ValueError: The CPU has no such value, or the value does not fit the register.

    """
    text = register.address.strip()
    name = text.lower().removeprefix(CPU)
    if name not in _NAMES:
        known = [CPU + one for one in _NAMES]
        raise ValueError(f"address: {unknown('value', text, known, 'the CPU')}")
    if register.writable:
        raise ValueError("writable: values of the CPU can only be read")
    if register.dims or register.scale:
        raise ValueError(
            f"{'type' if register.dims else 'scale'}: {text!r} is a single value, without dimensions and scale"
        )
    element = register.element
    if name == _STATE:
        length, others = _LONGEST_STATE, "BOOL, a whole number, or "
        fits = element.base == "BOOL" or element.base in INTEGERS
    elif name == _CLOCK:
        length, others = _CLOCK_LENGTH, f"{', '.join(_TIMES)}, or "
        fits = element.base in _TIMES
    else:
        length, others, fits = _TEXTS[name].length, "", False
    if not fits and (element.base not in ("STRING", "WSTRING") or element.length < length):
        raise ValueError(
            f"type: a register of {text!r} must be {others}STRING[{length}] or longer, not {register.type}"
        )
    return CpuTag(place, register, name)


class CpuValues:
    """The values of the CPU that a tag table names, and the questions that ask for them."""

    def __init__(self, tags: Sequence[CpuTag], mode: ModeQuery) -> None:
        """Prepare the questions.

        Args:
            tags: The registers.
            mode: The question for the operating mode, which the session asks in any case.

        """
        self._tags = tags
        self._mode = mode
        self._mode_seen = -1
        self._changes: dict[int, tuple[Value, int, int]] = {}  # by index: value, status, UTC time of the answer in ns
        self._bad: set[int] = set()
        self.queries: list[Query] = []
        for szl in (_MODULES, _COMPONENTS):
            if wanted := [tag for tag in tags if tag.name in _TEXTS and _TEXTS[tag.name].szl == szl]:
                self.queries.append(_TextsQuery(szl, wanted, self._note))
        if clocks := [tag for tag in tags if tag.name == _CLOCK]:
            self.queries.append(_ClockQuery(clocks, self._note))
        self._states = [tag for tag in tags if tag.name == _STATE]

    def begin(self) -> None:
        """Forget all values, because the session that starts may be with another CPU."""
        self._mode_seen = -1
        for tag in self._tags:
            if tag.place not in self._bad:  # a bad register keeps its status, which says more
                self._changes[tag.place] = None, BAD_WAITING_FOR_INITIAL_DATA, 0

    def store(self, image: RegisterImage) -> None:
        """Store in the image all values that are new since the last call."""
        if self._states:
            self._look_at_mode()
        for index, (value, status, source_ns) in self._changes.items():
            if value is None:
                image.fail(index, status, source_ns)
            else:
                image.put(index, value, source_ns)
        self._changes.clear()

    def _look_at_mode(self) -> None:
        mode = self._mode
        if mode.unknown:
            if self._mode_seen:
                self._mode_seen = 0
                why = "the controller does not report its operating mode"
                self._note(self._states, lambda _: None, BAD_NOT_SUPPORTED, why)
        elif mode.mode is not None and mode.answered_ns != self._mode_seen:
            self._mode_seen = mode.answered_ns
            self._note(self._states, self._state, BAD_NO_DATA, f"mode {mode.mode} is unknown")

    def _state(self, tag: CpuTag) -> Value:
        base, mode = tag.register.element.base, self._mode
        if base == "BOOL":
            return mode.runs
        return mode.mode if base in INTEGERS else MODES.get(mode.mode or 0)

    def _note(self, tags: Iterable[CpuTag], value_of: Callable[[CpuTag], Value], status: int, why: str) -> None:
        """Record new values of registers.

        A register without a value gets ``status``; ``why`` is the reason for the log.
        """
        now_ns = time.time_ns()
        good, bad = [], []
        for tag in tags:
            value = value_of(tag)
            self._changes[tag.place] = value, GOOD if value is not None else status, now_ns
            if (value is None) == (tag.place in self._bad):
                continue
            name = f"{tag.register.path} ({CPU}{tag.name})"
            if value is None:
                self._bad.add(tag.place)
                bad.append(name)
            else:
                self._bad.remove(tag.place)
                good.append(name)
        if bad:
            log.warning("%s: bad: %s", names_of(bad), why)
        if good:
            log.info("%s: good again", names_of(good))


_Note = Callable[[Iterable[CpuTag], Callable[[CpuTag], Value], int, str], None]


class _CpuQuery(Query):
    """A question whose answer gives registers their values; without an answer they are bad."""

    def __init__(self, service: Service, interval_ns: int | None, tags: Sequence[CpuTag], note: _Note) -> None:
        super().__init__(service, interval_ns)
        self.tags, self.note = tags, note

    def refused(self, refusal: RefusedError) -> None:
        """Make the registers bad, and ask again only in the next session."""
        self.skip()
        status = BAD_USER_ACCESS_DENIED if refusal.code == ACCESS_DENIED else BAD_NOT_SUPPORTED
        self.note(self.tags, lambda _: None, status, str(refusal))

    def given_up(self, why: str) -> None:
        """Make the registers bad, because the question is never asked again."""
        self.note(self.tags, lambda _: None, BAD_NOT_SUPPORTED, f"the controller {why}; shmio does not ask again")


class _TextsQuery(_CpuQuery):
    """The question for the texts of one list, asked once in each session."""

    def __init__(self, szl: int, tags: Sequence[CpuTag], note: _Note) -> None:
        super().__init__(READ_SZL, None, tags, note)
        self._szl = szl

    def data(self) -> bytes:
        """Return the data of the request."""
        return szl_data(self._szl)

    def answered(self, data: bytes) -> None:
        """Give the registers the texts in the records."""
        records: dict[int, bytes] = {}
        for record in szl_records(data, self._szl):
            records.setdefault(int.from_bytes(record[:2], "big"), record)
        self.note(
            self.tags,
            lambda tag: _text(tag, records),
            BAD_NO_DATA,
            f"list 0x{self._szl:04X} of the CPU does not contain this value",
        )


def _text(tag: CpuTag, records: Mapping[int, bytes]) -> str | None:
    """Return a tag's text from records by their numbers; None if they do not contain the text."""
    name, place = tag.name, _TEXTS[tag.name]
    record = records.get(place.record, b"")
    if name == "firmware":
        version = record[place.start : place.start + 4]
        return f"V{version[1]}.{version[2]}.{version[3]}" if version[:1] == b"V" and len(version) == 4 else None
    field = record[place.start : place.start + place.length]
    if len(record) < place.start + place.length:
        return None
    encoding = tag.register.encoding or ("" if is_encoded(tag.register.type) else WINDOWS_1252)
    return text_encoding(encoding).decode(bytes(field.partition(b"\0")[0])).strip()


class _ClockQuery(_CpuQuery):
    """The question for the time of the CPU's clock, asked once a second."""

    def __init__(self, tags: Sequence[CpuTag], note: _Note) -> None:
        super().__init__(READ_CLOCK, CLOCK_INTERVAL_NS, tags, note)

    def data(self) -> bytes:
        """Return the data of the request, which are empty."""
        return b""

    def answered(self, data: bytes) -> None:
        """Give the registers the time."""
        clock = parse_clock(data)
        text = None if clock is None else clock.isoformat(timespec="milliseconds")
        self.note(self.tags, lambda _: text, BAD_NO_DATA, "the CPU's clock has no valid time; set the clock")
