"""Absolute addresses of S7 controllers in the notation of TIA Portal, and of STEP 7 classic."""

from __future__ import annotations

import re
from typing import Final

_ENGLISH: Final = {"E": "I", "A": "Q", "Z": "C"}
_CLASSIC: Final = re.compile(r"(P?)([EAIQM])([BWD]?) ?([0-9]{1,5})(?:\.([0-7]))?(:P)?|([TCZ]) ?([0-9]{1,5})")
_IN_A_BLOCK: Final = re.compile(r"DB ?([0-9]{1,5})\.DB([XBWD]) ?([0-9]{1,5})(?:\.([0-7]))?")


def from_classic(address: str) -> str | None:
    """Return an address in TIA Portal's notation: ``%IW64`` for ``IW 64``, ``EW 64`` or ``%IW64``.

    Peripheral inputs and outputs, such as ``PIW 256``, become ``%IW256:P``. Return None if the text
    is not the address of a value.
    """
    text = " ".join(address.upper().split()).removeprefix("%")
    if match := _IN_A_BLOCK.fullmatch(text):
        number, width, byte, bit = match.groups()
        return (
            f"%DB{number}.DB{width}{byte}{'' if bit is None else f'.{bit}'}"
            if (bit is None) == (width != "X")
            else None
        )
    if (match := _CLASSIC.fullmatch(text)) is None:
        return None
    before, area, width, byte, bit, after, counter, number = match.groups()
    peripheral = before or after
    if counter:
        return f"%{_ENGLISH.get(counter, counter)}{number}"
    if (bit is None) != bool(width) or (peripheral and area == "M") or (before and (after or bit is not None)):
        return None
    return f"%{_ENGLISH.get(area, area)}{width}{byte}{'' if bit is None else f'.{bit}'}{':P' if peripheral else ''}"


def in_block(number: int, offset: int, bit: int | None, element_bytes: int) -> str:
    """Return the address of a value in data block ``number``, such as ``%DB5.DBW4``."""
    if bit is not None:
        return f"%DB{number}.DBX{offset}.{bit}"
    width = {1: "B", 2: "W", 4: "D"}.get(element_bytes)
    return f"%DB{number}.DB{width}{offset}" if width else f"%DB{number}.DBX{offset}.0"


def value_type(kind: str) -> str:
    """Return the type of the value of a tag of type ``kind``: S5TIME for TIMER, WORD for COUNTER, else ``kind``."""
    return {"TIMER": "S5TIME", "COUNTER": "WORD"}.get(kind.upper(), kind)
