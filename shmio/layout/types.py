"""The elementary types of S7: name, size and alignment.

Sizes and alignments are those of a block with standard access, as given in Siemens' STEP 7 help
under "Data types"; ``docs/reference/layout-rules.md`` has the whole table.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

MAX_STRING = 254
MAX_WSTRING = 16_382
DEFAULT_STRING = 254


@dataclass(frozen=True, slots=True)
class ElementType:
    """An elementary type; a string type includes its length.

    Attributes:
        name: The canonical name: ``DATE_AND_TIME``, never ``DT``; ``STRING[20]``.
        base: The name without the length.
        size: Size in bytes; 1 for BOOL, which takes one bit of it.
        align: Alignment in bytes, 1 or 2.
        length: Maximum number of characters of a string, 0 for all other types.

    """

    name: str
    base: str
    size: int
    align: int
    length: int = 0

    @property
    def stride(self) -> int:
        """Bytes from one array element to the next, except for BOOL, which packs bits."""
        return -(-self.size // self.align) * self.align


_SIZES = {
    1: ("BOOL", "BYTE", "CHAR", "SINT", "USINT"),
    2: ("WORD", "INT", "UINT", "DATE", "S5TIME", "WCHAR"),
    4: ("DWORD", "DINT", "UDINT", "REAL", "TIME", "TIME_OF_DAY"),
    6: ("POINTER",),
    8: ("LWORD", "LINT", "ULINT", "LREAL", "LTIME", "LTOD", "LDT", "DATE_AND_TIME"),
    10: ("ANY",),
    12: ("DTL",),
}
_FIXED = {
    name: ElementType(name, name, size, 1 if size == 1 else 2) for size, names in _SIZES.items() for name in names
}

# Hardware data types and parameter types are numbers that identify something. Siemens' help gives
# each one's underlying type ("Hardware data types"; "Format of the parameter types BLOCK, COUNTER,
# TIMER": a binary number in a word).
# fmt: off
_NAMING = {
    "UINT": (
        "HW_ANY", "HW_DEVICE", "HW_DPMASTER", "HW_DPSLAVE", "HW_IO", "HW_IOSYSTEM", "HW_SUBMODULE", "HW_MODULE",
        "HW_INTERFACE", "HW_IEPORT", "HW_HSC", "HW_PWM", "HW_PTO", "PORT", "RTM", "PIP", "DB_ANY", "DB_WWW", "DB_DYN",
        "TIMER", "COUNTER", "BLOCK_FB", "BLOCK_FC", "BLOCK_DB", "BLOCK_SDB",
    ),
    "INT": (
        "OB_ANY", "OB_DELAY", "OB_TOD", "OB_CYCLIC", "OB_ATT", "OB_PCYCLE", "OB_HWINT", "OB_DIAG", "OB_TIMEERROR",
        "OB_STARTUP",
    ),
    "WORD": ("CONN_ANY", "CONN_PRG", "CONN_OUC"),
    "DWORD": ("AOM_IDENT", "EVENT_ANY", "EVENT_ATT", "EVENT_HWINT", "CONN_R_ID", "C_ALARM_S", "C_ALARM_SD"),
    "ANY": ("REMOTE",),
}
# fmt: on
ALIASES = {
    "TOD": "TIME_OF_DAY",
    "DT": "DATE_AND_TIME",
    "LTIME_OF_DAY": "LTOD",
    "DATE_AND_LTIME": "LDT",
    **{alias: name for name, aliases in _NAMING.items() for alias in aliases},
}
BYTE = _FIXED["BYTE"]
POINTER = _FIXED["POINTER"]
STRUCTURED = frozenset({"STRING", "WSTRING", "DATE_AND_TIME", "DTL"})  # made of several values, as Siemens sees it
INTEGERS = frozenset(
    ["BYTE", "WORD", "DWORD", "LWORD", "SINT", "USINT", "INT", "UINT", "DINT", "UDINT", "LINT", "ULINT"]
)
_STRING = re.compile(r"(W?STRING)(?:\[([0-9]{1,5})\])?")


def string_limit(base: str) -> int:
    """Return the maximum declared length of ``STRING`` or ``WSTRING``, in characters."""
    return MAX_STRING if base == "STRING" else MAX_WSTRING


@lru_cache(maxsize=1024)
def element_type(name: str) -> ElementType | None:
    """Return the elementary type with this name, or None; case does not matter, aliases count."""
    upper = name.upper()
    fixed = _FIXED.get(ALIASES.get(upper, upper))
    if fixed is not None:
        return fixed
    if (match := _STRING.fullmatch(upper)) is None:
        return None
    base, length = match[1], int(match[2] or DEFAULT_STRING)
    if not 1 <= length <= string_limit(base):
        return None
    size = length + 2 if base == "STRING" else 2 * length + 4
    return ElementType(f"{base}[{length}]", base, size, 2, length)
