"""Addresses of Modbus registers in tag tables, and the words that a value takes there.

An address is ``[unit N] TABLE NUMBER[.BIT] [TYPE] [word_order=ORDER] [byte_order=ORDER]``: ``holding
100``, ``unit 2 input 7``, ``coil 3``, ``holding 100.3``, ``holding 100 UINT``. Numbers count from 0, as
in the protocol. An address may also be a number as in manuals, which count from 1 and put the digit of
the table first: ``40101`` and ``400101`` mean ``holding 100``. TYPE is the type in the device; it may be
left out if it is that of the register. Tag tables have keys for the orders, which become a part of the
address.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal

from shmio.layout.encodings import text_encoding
from shmio.layout.model import ElementType, Register, element_type
from shmio.layout.values.codec import Scalar, encode_text

Order = Literal["big", "little"]
MAX_ADDRESS: Final = 65_535
MAX_UNIT: Final = 255


class Table(Enum):
    """A table of a Modbus device (specification, section 4.3)."""

    COIL = "coil"
    DISCRETE = "discrete"
    INPUT = "input"
    HOLDING = "holding"

    @property
    def of_bits(self) -> bool:
        """True if an address of the table is a bit, False if it is a word of 16 bits."""
        return self in (Table.COIL, Table.DISCRETE)

    @property
    def writable(self) -> bool:
        """True if a client may write to the table."""
        return self in (Table.COIL, Table.HOLDING)


_OF_DIGIT: Final = {"0": Table.COIL, "1": Table.DISCRETE, "3": Table.INPUT, "4": Table.HOLDING}
_ADDRESS: Final = re.compile(
    r"(?:unit\s+(?P<unit>[0-9]{1,3})\s+)?"
    r"(?:(?P<table>coil|discrete|input|holding)\s+(?P<number>[0-9]{1,5})|(?P<manual>[0134][0-9]{4,5}))"
    r"(?:\.(?P<bit>[0-9]{1,2}))?(?:\s+(?P<type>[A-Za-z_]+(?:\[[0-9]+\])?))?"
    r"(?:\s+word_order=(?P<words>big|little))?(?:\s+byte_order=(?P<bytes>big|little))?",
    re.IGNORECASE,
)
_ORDERS: Final[Mapping[str, Order]] = {"big": "big", "little": "little"}
_CODES: Final = {
    "SINT": "b", "USINT": "B", "BYTE": "B", "INT": "h", "UINT": "H", "WORD": "H", "DINT": "i", "UDINT": "I",
    "DWORD": "I", "TIME": "i", "REAL": "f", "LINT": "q", "ULINT": "Q", "LWORD": "Q", "LREAL": "d", "LTIME": "q",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Address:
    """The place of a register's first element in a device.

    Attributes:
        unit: Unit id of the device behind a gateway; None: the unit id that the source has by
            default.
        table: The table.
        number: Number in the table, from 0.
        bit: Bit of the word, 0 to 15; None: the whole word.
        kind: Type of the element in the device.
        word_order: Order of the words within a number; None: the order that the source has by
            default.
        byte_order: Order of the bytes within a word; None: as for ``word_order``.

    """

    unit: int | None
    table: Table
    number: int
    bit: int | None
    kind: ElementType
    word_order: Order | None = None
    byte_order: Order | None = None

    @property
    def width(self) -> int:
        """Number of table entries that an element takes: bits or words."""
        if self.table.of_bits or self.bit is not None:
            return 1
        return -(-self.kind.length // 2) if self.kind.base == "STRING" else max(1, self.kind.size // 2)


def parse(register: Register) -> Address:
    """Return the address of a register of a tag table.

    Raises:
        ValueError: The address is malformed, or does not suit the register's type.

    """
    text = register.address.strip()
    if not text:
        raise ValueError("the key `address` is missing; write one such as holding 100")
    found = _ADDRESS.fullmatch(text)
    if found is None:
        raise ValueError(
            f"{text!r} is not a Modbus address; write coil, discrete, input or holding and a number from 0, such as "
            "holding 100, or the number of a manual, such as 40101"
        )
    if found["manual"]:
        table, number = _OF_DIGIT[found["manual"][0]], int(found["manual"][1:]) - 1
    else:
        table, number = Table(found["table"].lower()), int(found["number"])
    unit = None if found["unit"] is None else int(found["unit"])
    if not 0 <= number <= MAX_ADDRESS or (unit is not None and unit > MAX_UNIT):
        raise ValueError(f"{text!r}: the number must be from 0 to {MAX_ADDRESS}, and the unit id from 0 to {MAX_UNIT}")
    kind = register.element if found["type"] is None else element_type(found["type"])
    if kind is None:
        raise ValueError(f"{text!r}: unknown type {found['type']!r}")
    words, octets = (None if found[key] is None else _ORDERS[found[key].lower()] for key in ("words", "bytes"))
    address = Address(unit, table, number, None if found["bit"] is None else int(found["bit"]), kind, words, octets)
    _check(address, register, text)
    return address


def _check(address: Address, register: Register, text: str) -> None:
    """Raise ValueError if the address does not suit the register."""
    kind, table, is_bit = address.kind, address.table, register.type == "BOOL"
    if address.bit is not None and (table.of_bits or address.bit > 15):
        raise ValueError(f"{text!r}: only a word in the tables input and holding has bits, numbered 0 to 15")
    if is_bit != (table.of_bits or address.bit is not None):
        raise ValueError(
            f"{text!r}: a BOOL needs a coil, a discrete input, or a bit of a word such as holding 100.3"
            if is_bit
            else f"{text!r}: a {register.type} needs a word; one bit is a BOOL"
        )
    if is_bit and register.dims and not table.of_bits:
        raise ValueError(f"{text!r}: an array of BOOL needs coils or discrete inputs")
    if is_bit and (address.word_order or address.byte_order):
        raise ValueError(f"{text!r}: a BOOL has no order of words or bytes; leave out word_order and byte_order")
    if not is_bit and kind.base != "STRING" and kind.base not in _CODES:
        raise ValueError(f"{text!r}: Modbus has no {kind.name}; it has {', '.join(_CODES)} and STRING[n]")
    if (kind.base == "STRING") != (register.element.base == "STRING"):
        raise ValueError(f"{text!r}: a {kind.name} of the device does not fit a {register.type}")
    if register.element.base != "STRING" and not is_bit and register.element.base not in _CODES:
        raise ValueError(f"a number of the device does not fit a {register.type}")
    if address.number + register.count * address.width - 1 > MAX_ADDRESS:
        raise ValueError(f"{text!r}: the value ends after address {MAX_ADDRESS}")


class WordCodec:
    """Converts the elements of one register between the device's words and values."""

    def __init__(self, address: Address, register: Register, word_order: Order, byte_order: Order) -> None:
        """Prepare the conversion. The address may have other orders than those given here."""
        self._text = address.kind.base == "STRING"
        self._bytes, self._length = 2 * address.width, address.kind.length
        self._swap_bytes = (address.byte_order or byte_order) == "little"
        self._swap_words = (address.word_order or word_order) == "little" and not self._text and address.width > 1
        self._scale = register.scale
        self._whole = register.element.base not in ("REAL", "LREAL")
        self._whole_there = address.kind.base not in ("REAL", "LREAL")
        code = "B" if self._text else _CODES[address.kind.base]
        self._struct = struct.Struct(f">{'x' if address.kind.size == 1 else ''}{code}")
        self._name = address.kind.name
        own = (
            b"\xff" * self._length + b"\0" * (self._bytes - self._length)
            if self._text
            else (b"\0\xff" if address.kind.size == 1 else b"\xff" * self._bytes)
        )
        self.masks: Final = struct.unpack(f">{address.width}H", self.ordered(own))
        """For each word of an element, the bits that the element takes. The rest belongs to something else."""
        self._encoding = text_encoding(register.encoding)

    @property
    def swaps(self) -> tuple[bool, bool]:
        """Whether the device has the words, and the bytes of a word, in the order that is not usual."""
        return self._swap_words, self._swap_bytes

    def decode(self, data: bytes) -> Scalar:
        """Return an element's value. ``data`` are the element's words as the device sent them."""
        data = self.ordered(data)
        if self._text:
            return self._encoding.decode(data[: self._length].partition(b"\0")[0])
        number: int | float = self._struct.unpack(data)[0]
        value = number if self._scale is None else number * self._scale[0] + self._scale[1]
        return round(value) if self._whole and math.isfinite(value) else value

    def encode(self, value: Scalar) -> bytes:
        """Return a value as words to send; raise ValueError if the device's type cannot hold it."""
        if self._text:
            data = encode_text(value, self._encoding, self._name)
            if len(data) > self._length:
                raise ValueError(f"the device's {self._name} holds {self._length} bytes, not {len(data)}")
            return self.ordered(data.ljust(self._bytes, b"\0"))
        if not isinstance(value, int | float):
            raise TypeError(f"{value!r} is not a number")
        number: float = value if self._scale is None else (value - self._scale[1]) / self._scale[0]
        try:
            return self.ordered(self._struct.pack(round(number) if self._whole_there else float(number)))
        except (struct.error, OverflowError, ValueError):
            raise ValueError(f"{value} does not fit the device's {self._name}") from None

    def ordered(self, data: bytes) -> bytes:
        """Convert words from the device's order of bytes and words to big-endian, or back."""
        if not (self._swap_bytes or self._swap_words):
            return data
        words = [data[at : at + 2] for at in range(0, len(data), 2)]
        if self._swap_words:
            words.reverse()
        return b"".join(word[::-1] for word in words) if self._swap_bytes else b"".join(words)
