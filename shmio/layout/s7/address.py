"""Addresses of values in an S7 controller, as tag tables name them.

Examples are ``DB201.DBX0.1``, ``DB201.DBW4``, ``%IW256``, ``%M3.7`` and ``T5``. ``%`` may be left
out, and the German letters E, A and Z stand for I, Q and C. If the number in the controller has
another type than the register, its type follows: ``DB1.DBW4 INT``.
"""

from __future__ import annotations

import re
from enum import IntEnum
from typing import Final, NamedTuple

from shmio.layout.model import NUMBERS, ElementType, Register, array_size, element_type

MAX_NUMBER: Final = 65_535
CPU: Final = "cpu."
"""Prefix of the addresses of values of the CPU itself."""
_AREA_BYTES: Final = 65_536


class Area(IntEnum):
    """A memory area, with its code in the protocol."""

    PERIPHERAL = 0x80
    INPUT = 0x81
    OUTPUT = 0x82
    MARKER = 0x83
    BLOCK = 0x84
    COUNTER = 0x1C
    TIMER = 0x1D

    @property
    def numbered(self) -> bool:
        """True for timers and counters, whose addresses are numbers and not offsets of bytes."""
        return self in (Area.COUNTER, Area.TIMER)

    @property
    def read_only(self) -> str:
        """Why the area cannot be written to; empty if it can."""
        return _READ_ONLY.get(self, "")


_READ_ONLY: Final = {
    Area.PERIPHERAL: "inputs cannot be written: the controller reads them from its modules",
    Area.INPUT: "inputs cannot be written: the controller overwrites them from its modules in each cycle",
    Area.COUNTER: "counters can only be read; let the controller's program set them",
    Area.TIMER: "timers can only be read; let the controller's program start them",
}
_LETTERS: Final = {
    "I": Area.INPUT, "E": Area.INPUT, "Q": Area.OUTPUT, "A": Area.OUTPUT, "M": Area.MARKER,
    "T": Area.TIMER, "C": Area.COUNTER, "Z": Area.COUNTER,
}  # fmt: skip
_WIDTHS: Final = {"B": 1, "W": 2, "D": 4}
_ADDRESS: Final = re.compile(
    r"%?(?:DB(?P<db>[0-9]{1,5})\.DB(?P<block_width>[XBWD])|(?P<area>[IEQAM])(?P<width>[XBWD]?)|(?P<numbered>[TCZ]))"
    r"(?P<start>[0-9]{1,5})(?:\.(?P<bit>[0-7]))?(?P<peripheral>:P)?(?:\s+(?P<type>[A-Z]{3,5}))?",
    re.ASCII | re.IGNORECASE,
)
_OF_TIMERS: Final = frozenset({"S5TIME", "WORD", "TIME"})
_OF_COUNTERS: Final = frozenset({"WORD", "INT", "UINT"})


class Address(NamedTuple):
    """The place of a value in a controller, and its type there."""

    area: Area
    db: int
    """Number of the data block; 0 in other areas."""
    start: int
    """First byte, or the number of the timer or counter."""
    bit: int | None
    """The bit of a single BOOL; None for all other types."""
    kind: ElementType
    """Type of the value, or of each element, in the controller."""
    size: int
    """Size of the value in the controller, in bytes."""

    @property
    def text(self) -> str:
        """The place in TIA Portal's notation."""
        if self.area.numbered:
            return f"%{'T' if self.area is Area.TIMER else 'C'}{self.start}"
        bit = "" if self.bit is None else f".{self.bit}"
        letter = "X" if bit else {1: "B", 2: "W", 4: "D"}.get(self.size, "B")
        if self.area is Area.BLOCK:
            return f"%DB{self.db}.DB{letter}{self.start}{bit}"
        name = {Area.INPUT: "I", Area.OUTPUT: "Q", Area.MARKER: "M", Area.PERIPHERAL: "I"}[self.area]
        tail = ":P" if self.area is Area.PERIPHERAL else ""
        return f"%{name}{'' if bit else letter}{self.start}{bit}{tail}"


def is_of_cpu(text: str) -> bool:
    """Return whether an address names a value of the CPU itself, and not a value in its memory."""
    return text.strip().lower().startswith(CPU)


def is_address(text: str) -> bool:
    """Return whether a text has the form of an address."""
    return _ADDRESS.fullmatch(text.strip()) is not None


def parse(register: Register) -> Address:
    """Return the address of a register.

    Raises:
        ValueError: The register has no address, or an address that does not fit its type.

    """
    text = register.address.strip()
    if not text:
        raise ValueError(
            "address: this key is needed, because other registers have it; write, for example, DB201.DBW4, "
            "%IW256, %M3.7 or T5"
        )
    match = _ADDRESS.fullmatch(text)
    if match is None:
        raise ValueError(
            f"address: {text[:80]!r} is not an S7 address; expected one such as DB201.DBW4, %IW256, %M3.7 or T5"
        )
    start = int(match["start"])
    if start > MAX_NUMBER:
        raise ValueError(f"address: {text!r}: the largest number is {MAX_NUMBER}")
    if match["numbered"]:
        return _of_number(text, match, register, start)
    area, db = Area.BLOCK, 0
    if match["area"]:
        area = _LETTERS[match["area"].upper()]
    else:
        db = int(match["db"])
        if not 1 <= db <= MAX_NUMBER:
            raise ValueError(f"address: {text!r}: data blocks are numbered 1 to {MAX_NUMBER}")
    if match["peripheral"]:
        if area is not Area.INPUT:
            raise ValueError(f"address: {text!r}: only inputs can be read past the process image; leave out ':P'")
        area = Area.PERIPHERAL
    kind = _kind(text, match["type"], register)
    size = array_size(kind, register.shape)
    bit = _bit(text, (match["block_width"] or match["width"]).upper(), match["bit"], register, kind)
    if start + size > _AREA_BYTES:
        raise ValueError(
            f"address: {text!r}: {size} bytes from byte {start} on end after byte {_AREA_BYTES - 1}, the last one"
        )
    return Address(area, db, start, bit, kind, size)


def _of_number(text: str, match: re.Match[str], register: Register, start: int) -> Address:
    """Return the address of a timer or counter."""
    area = _LETTERS[match["numbered"].upper()]
    valid = _OF_TIMERS if area is Area.TIMER else _OF_COUNTERS
    if match["bit"] or match["peripheral"] or match["type"]:
        raise ValueError(f"address: {text!r}: a timer or counter has only a number")
    if register.dims or register.type not in valid:
        raise ValueError(f"type: {text!r} must have one of the types {', '.join(sorted(valid))}, not {register.type}")
    word = element_type("WORD")
    assert word is not None  # noqa: S101 - for the type checker
    return Address(area, 0, start, None, word, 2)


def _kind(text: str, name: str | None, register: Register) -> ElementType:
    """Return the type in the controller: the one in the address, or the register's own."""
    if name is None:
        return register.element
    kind = element_type(name)
    if kind is None or kind.base not in NUMBERS or register.type not in NUMBERS:
        raise ValueError(f"address: {text!r}: only numbers have another type in the controller, such as INT")
    return kind


def _bit(text: str, letter: str, bit: str | None, register: Register, kind: ElementType) -> int | None:
    """Check width and bit of an address, and return the bit of a single BOOL."""
    if (bit is None) != (letter in _WIDTHS):
        raise ValueError(
            f"address: {text!r}: write a bit with its byte and number, such as DB1.DBX0.1 or %M3.7, and other values "
            "with a width, such as DB1.DBW2 or %MB3"
        )
    if kind.base == "BOOL" and not register.dims:
        if bit is None:
            raise ValueError(
                f"address: {text!r}: a BOOL is one bit; add the number of the bit, such as DB1.DBX0.1 or %M3.7"
            )
        return int(bit)
    if bit is not None and int(bit):
        raise ValueError(f"address: {text!r}: {register.type} begins at a whole byte, not at bit {bit}")
    if letter in _WIDTHS and not register.dims and kind.size < _WIDTHS[letter]:
        raise ValueError(
            f"address: {text!r} has {_WIDTHS[letter]} bytes, but {kind.name} has {kind.size}; correct one of them, "
            f"or name the controller's type after the address, such as {f'{text} INT'!r}"
        )
    return None
