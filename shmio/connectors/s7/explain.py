"""Messages that explain why a controller refused a request, and what to do about it.

No public standard says in which cases a family of controllers sends which code. The messages
therefore follow reports of users with real CPUs. docs/how-to/connect-an-s7-plc.md names these
reports.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from shmio.errors import ConnectorError
from shmio.layout.topic import shorten

_MOST_NAMES: Final = 3

# Return codes of an item.
ITEM_OK = 0xFF
ACCESS_DENIED, OUT_OF_RANGE, NO_SUCH_TYPE, OTHER_SIZE, NO_SUCH_OBJECT = 0x03, 0x05, 0x06, 0x07, 0x0A

KNOWN_CODES: Final = frozenset(
    {ITEM_OK, *range(0x02), 0x03, *range(0x05, 0x08), 0x0A, *range(0x10, 0x15), *range(0x19, 0x1F), 0x20, 0x21}
)
"""The codes for which python-snap7 has texts. The library is imported only for a text, because that is slow."""

_NO_OPTIMIZED = "if the block is optimized, clear 'Optimized block access', compile and load it, or read it by OPC UA"
_ACCESS_DENIED = (
    "access denied {where}; enable 'Permit access with PUT/GET communication' and 'Full access' in the CPU's "
    f"protection settings; {_NO_OPTIMIZED}"
)
_PROTECTED = "the CPU's protection level forbids the access {where}; choose 'Full access' in its protection settings"

# Errors of a whole job for which the texts of python-snap7 do not name the remedy.
_ERRORS = {
    0x8104: _ACCESS_DENIED,  # S7-1200/1500: any job if PUT/GET is off, or the block is optimized
    0x8304: _ACCESS_DENIED,  # S7-1200/1500: writes if PUT/GET is off
    0xD241: _PROTECTED,
    0xD602: _PROTECTED,
}


class RefusedError(ConnectorError):
    """The controller refused a job, or an item of a job.

    ``code`` is the return code of the refused item; 0 if the controller refused the whole job.
    """

    def __init__(self, message: str, code: int = 0) -> None:
        super().__init__(message)
        self.code = code


def explain_error(error: int) -> str:
    """Return a message for the error class and code in the header of an answer."""
    if error in _ERRORS:
        return _ERRORS[error].format(where=f"(error 0x{error:04X})")
    from snap7.error import S7_PROTOCOL_ERROR_CODES  # noqa: PLC0415  a source without errors starts faster

    known = S7_PROTOCOL_ERROR_CODES.get(error)
    return f"the controller refused the request: {known or 'unknown error'} (error 0x{error:04X})"


def explain_read(code: int, db_number: int, size: int) -> str:
    """Return a message for the return code of an item that reads a block of ``size`` bytes."""
    if code == OUT_OF_RANGE:
        return (
            f"DB{db_number} does not have {size} bytes (item code 0x05); if the layout is of another version of the "
            f"block, export it again; {_NO_OPTIMIZED}"
        )
    return f"DB{db_number}: {explain_item(code)}"


def explain_size(db_number: int, size: int, found: int, name: str = "", gone: Sequence[str] = ()) -> str:
    """Return a message for a block that has ``found`` bytes, while its layout has ``size``.

    ``name`` is the name of the layout. ``gone`` are the names of registers beyond the block's end.
    """
    if not found:
        return (
            f"DB{db_number} has no byte that can be addressed (item code 0x05), because it is empty or optimized; "
            f"{_NO_OPTIMIZED}"
        )
    if gone:
        return (
            f"{block_name(db_number, name)} has {found} bytes, not {size} as in its layout (item code 0x05); export "
            f"the layout again; beyond the end of the block: {names_of(gone)}"
        )
    return (
        f"DB{db_number} does not have {size} bytes but {found} bytes (item code 0x05): the layout is of another "
        "version of the block; export it again"
    )


def block_name(db_number: int, name: str) -> str:
    """Return a text with a block's number, and with its name unless the name only repeats the number."""
    return f"DB{db_number}" if name.upper() in {"", f"DB{db_number}"} else f'DB{db_number} "{shorten(name, 40)}"'


def names_of(paths: Sequence[str]) -> str:
    """Return a text with the first few names, and with the number of the others."""
    text = ", ".join(shorten(path, 40) for path in paths[:_MOST_NAMES])
    return text if len(paths) <= _MOST_NAMES else f"{text} and {len(paths) - _MOST_NAMES} more"


def explain_write(code: int, db_number: int, last: int) -> str:
    """Return a message for the return code of an item that writes up to byte ``last``."""
    if code == OUT_OF_RANGE:
        return (
            f"DB{db_number} has no byte {last} (item code 0x05): the layout is of another version of the block; export "
            "it again"
        )
    return f"DB{db_number}: {explain_item(code)}"


def explain_place(code: int, text: str, db_number: int, last: int) -> str:
    """Return a message for the return code of an item that reads one register of a tag table.

    Args:
        code: The return code.
        text: The register's address.
        db_number: The number of the register's data block; 0 in other areas.
        last: The offset of the register's last byte.

    """
    if code == OUT_OF_RANGE and db_number:
        return (
            f"DB{db_number} has no byte {last} (item code 0x05); correct the address {text}, or load the right version "
            f"of the block; {_NO_OPTIMIZED}"
        )
    return explain_item(code)


def is_known(code: int) -> bool:
    """Return whether this return code of an item has a known meaning."""
    return code in KNOWN_CODES


def _item_texts() -> Mapping[int, str]:
    from snap7.s7protocol import S7_RETURN_CODES  # noqa: PLC0415  a source without errors starts faster

    return S7_RETURN_CODES


def explain_item(code: int) -> str:
    """Return a message for the return code of an item, without naming the item."""
    where = f"(item code 0x{code:02X})"
    if code == ACCESS_DENIED:
        return _ACCESS_DENIED.format(where=where)
    if code == NO_SUCH_OBJECT:
        return (
            f"the block does not exist {where}; check dbNumber, and that the block is loaded; on an S7-1200 or "
            f"S7-1500, {_NO_OPTIMIZED}"
        )
    if code == OUT_OF_RANGE:
        return f"the controller has no such address {where}; correct the address; {_NO_OPTIMIZED}"
    if code in {NO_SUCH_TYPE, OTHER_SIZE}:
        return f"the controller does not accept data of this type or length {where}"
    return f"the controller refused the request: {_item_texts().get(code, 'unknown error')} {where}"
