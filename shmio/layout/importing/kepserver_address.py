"""Translate addresses of KEPServerEX: those of its drivers for Siemens controllers and for Modbus devices.

The drivers' help pages define the syntax ("Standard S7-300/400/1200/1500 Item Syntax", "STEP 7 Item
Syntax", "Modbus Addressing")::

    DB5,INT2   DB5.REAL4   DB5,X60.3   DB5,STRING8.20   DB5,INT40[2][3]   MW12   M10.2   PIW256   T5
    400101   400001.3   400100.20H   400010 [5]   H40001

Whatever has no exact counterpart is refused, because another place or size gives wrong values.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from shmio.layout.model import Dims, element_type


class Place(NamedTuple):
    """An address of the device in shmio's notation.

    Attributes:
        modbus: True for a Modbus device, False for an S7 controller.
        address: The address, without a type.
        kind: The type there, such as ``UINT`` or ``STRING[20]``.
        dims: Bounds of an array; ``()`` for a single value.
        low_first: True if the low byte of each word comes first, unlike in Modbus.

    """

    modbus: bool
    address: str
    kind: str
    dims: Dims
    low_first: bool = False


NUMBERS: Final = {
    "char": "SINT", "byte": "USINT", "short": "INT", "word": "UINT", "long": "DINT", "dword": "UDINT",
    "llong": "LINT", "qword": "ULINT", "float": "REAL", "double": "LREAL",
}  # fmt: skip
"""Types of numbers in KEPServerEX, and their S7 names."""
KINDS: Final = {"boolean": "BOOL", "string": "STRING", **NUMBERS}
_SHAPE: Final = re.compile(r"(?P<place>[^\[\]]*?)\s*(?P<counts>(?:\[\s*[0-9]{1,6}\s*\]\s*){0,3})")
_OTHER: Final = "the address {!r} is not one of a Modbus device or S7 controller"
_MAX_ADDRESS: Final = 100  # characters
_MAX_TEXT: Final = 240  # characters of a text in Modbus
_MODBUS: Final = re.compile(
    r"(?:(?P<hex>H)?(?P<table>[0134])(?P<item>[0-9A-F]{1,5}))(?:\.(?P<part>[0-9]{1,3})(?P<text>[HL]?))?"
)
_S7: Final = re.compile(
    r"(?:DB(?P<db>[0-9]{1,5})[,.](?:DB)?|(?P<peripheral>P?)(?P<area>[IEQAMF]))(?P<letters>[A-Z]*)(?P<byte>[0-9]{1,5})"
    r"(?:\.(?P<part>[0-9]{1,3}))?"
)
_NUMBERED: Final = re.compile(r"(?P<area>[TCZ])(?P<number>[0-9]{1,5})")
_AREAS: Final = {"E": "I", "A": "Q", "F": "M"}
# The data type that the driver uses where the tag has the type Default.
_DEFAULTS: Final = {
    "X": "boolean", "": "boolean", "B": "byte", "BYTE": "byte", "C": "char", "CHAR": "char", "W": "word",
    "WORD": "word",
    "I": "short", "INT": "short", "D": "dword", "DWORD": "dword", "DI": "long", "DINT": "long", "REAL": "float",
    "LREAL": "double", "LINT": "llong", "ULINT": "qword", "LWORD": "qword", "STRING": "string",
    "DATE": "string", "TIME": "string", "TOD": "string", "DT": "string",
}  # fmt: skip
_MOMENTS: Final = {"DATE": "DATE", "TIME": "TIME", "TOD": "TIME_OF_DAY", "DT": "DATE_AND_TIME"}
"""Times, which KEPServerEX shows as text."""


def translate(address: str, data_type: str) -> Place:
    """Return the place of a tag.

    Args:
        address: The address in the export.
        data_type: The data type in the export, such as ``Word Array`` or ``Default``.

    Raises:
        ValueError: The tag has no counterpart; the message says why.

    """
    kind, _, array = data_type.strip().lower().partition(" ")
    if array not in ("", "array") or (kind not in KINDS and kind != "default"):
        raise ValueError(f"the type {data_type!r} has no counterpart")
    shape = _SHAPE.fullmatch(address.strip()) if len(address) <= _MAX_ADDRESS else None
    if shape is None:
        raise ValueError(_OTHER.format(address[:_MAX_ADDRESS]))
    counts = [int(count) for count in re.findall(r"[0-9]+", shape["counts"])]
    if len(counts) > 2 or not all(counts):
        raise ValueError(f"{address!r}: expected one or two lengths from 1 on, as in [10] or [2][3]")
    if counts and not array and kind != "default":
        raise ValueError(f"{address!r} is an array, but the type is {data_type!r}")
    if array and not counts:
        raise ValueError("an array without one or two lengths at the end of its address, as in 400001 [10]")
    dims = tuple((0, count - 1) for count in counts)
    place = "".join(shape["place"].upper().split())
    if (match := _MODBUS.fullmatch(place)) is not None:
        return _in_modbus(address, match, kind, dims)
    if (match := _S7.fullmatch(place)) is not None:
        return _in_s7(address, match, kind, dims)
    if (match := _NUMBERED.fullmatch(place)) is not None and not dims:
        return _numbered(address, match, kind)
    raise ValueError(_OTHER.format(address[:_MAX_ADDRESS]))


def _in_modbus(address: str, match: re.Match[str], kind: str, dims: Dims) -> Place:
    digits, part, is_bit = match["item"], match["part"], match["table"] in "01"
    if not match["hex"] and not digits.isdecimal():
        raise ValueError(_OTHER.format(address[:_MAX_ADDRESS]))
    item = int(digits, 16 if match["hex"] else 10)
    if not 1 <= item <= 65_536:
        raise ValueError(f"{address!r}: the number must be from 1 to 65536")
    width = 4 if len(digits) <= 4 and item <= 9999 else 5
    number = f"{match['table']}{item:0{width}d}"
    if kind == "default":
        kind = "string" if match["text"] else "boolean" if is_bit or part is not None else "word"
    if kind == "string":
        if is_bit or not match["text"] or not 1 <= int(part) <= _MAX_TEXT or dims:
            raise ValueError(f"{address!r}: a text needs words, its length, and H or L, as in 400100.20H")
        return Place(True, number, f"STRING[{int(part)}]", (), low_first=match["text"] == "L")
    if kind == "boolean":
        if is_bit == (part is not None) or match["text"] or (part is not None and (int(part) > 15 or dims)):
            raise ValueError(
                f"{address!r}: a Boolean needs a coil, a discrete input, or one bit of a word, as in 400001.3"
            )
        return Place(True, number if part is None else f"{number}.{int(part)}", "BOOL", dims)
    if is_bit or part is not None or kind in ("char", "byte"):
        raise ValueError(f"{address!r}: the type {kind!r} does not fit the address")
    return Place(True, number, KINDS[kind], dims)


def _in_s7(address: str, match: re.Match[str], kind: str, dims: Dims) -> Place:
    letters, part, byte = match["letters"], match["part"], int(match["byte"])
    default = _DEFAULTS.get(letters)
    if default is None or (match["db"] and not letters):
        raise ValueError(f"{address!r}: the data type {letters!r} of the address has no counterpart")
    if default == "boolean" or (part is not None and default == "byte" and kind in ("default", "boolean")):
        return _bit(address, match, kind, dims)
    if kind == "default":
        kind = default
    if kind == "boolean":
        raise ValueError(f"{address!r}: a Boolean needs one bit, as in DB5,X60.3")
    if (kind == "string") != (default == "string") or (kind == "string" and dims):
        raise ValueError(f"{address!r}: the type {kind!r} does not fit the address")
    if letters in _MOMENTS:
        if part is not None:
            raise ValueError(f"{address!r}: a {letters} has no part")
        return _placed(match, byte, _MOMENTS[letters], dims)
    if kind == "string":
        if part is None or not 1 <= int(part) <= 254:
            raise ValueError(f"{address!r}: expected a text with its length, 1 to 254, as in DB5,STRING8.20")
        return _placed(match, byte, f"STRING[{int(part)}]", ())
    if part is not None:
        raise ValueError(f"{address!r}: only a Boolean has the number of a bit, and only a STRING has a length")
    if _bytes(KINDS[kind]) != _bytes(KINDS[default]):
        raise ValueError(f"{address!r}: a {kind} has another size than a {letters}")
    return _placed(match, byte, KINDS[kind], dims)


def _bit(address: str, match: re.Match[str], kind: str, dims: Dims) -> Place:
    part = match["part"]
    if kind not in ("boolean", "default") or part is None or int(part) > 7:
        raise ValueError(f"{address!r}: a Boolean needs one bit from 0 to 7 of a byte, as in DB5,X60.3")
    if dims and (len(dims) > 1 or int(part)):
        raise ValueError(f"{address!r}: an array of Boolean needs one length, and begins at bit 0")
    if match["peripheral"]:
        raise ValueError(f"{address!r}: peripheral inputs and outputs have no bits")
    return Place(False, f"{_area(match)}{'X' if match['db'] else ''}{int(match['byte'])}.{int(part)}", "BOOL", dims)


def _placed(match: re.Match[str], byte: int, kind: str, dims: Dims) -> Place:
    """Return the place of a value of whole bytes."""
    if match["peripheral"] and match["area"] in "QA":
        raise ValueError("peripheral outputs cannot be read")
    width = {1: "B", 2: "W", 4: "D"}.get(_bytes(kind))
    whole = f"{width}{byte}" if width else f"{'X' if match['db'] else ''}{byte}.0"
    return Place(False, f"{_area(match)}{whole}{':P' if match['peripheral'] else ''}", kind, dims)


def _numbered(address: str, match: re.Match[str], kind: str) -> Place:
    """Return the place of a timer, whose value KEPServerEX gives in ms, or of a counter."""
    is_timer = match["area"] == "T"
    valid = {"long": "TIME", "dword": "TIME"} if is_timer else {"short": "INT", "word": "UINT"}
    found = valid.get("long" if kind == "default" and is_timer else "word" if kind == "default" else kind)
    if found is None:
        raise ValueError(f"{address!r}: a {'timer' if is_timer else 'counter'} has the type {' or '.join(valid)}")
    return Place(False, f"{'T' if is_timer else 'C'}{int(match['number'])}", found, ())


def _area(match: re.Match[str]) -> str:
    if match["db"]:
        return f"DB{int(match['db'])}.DB"
    return _AREAS.get(match["area"], match["area"])


def _bytes(kind: str) -> int:
    element = element_type(kind)
    return 0 if element is None else element.size
