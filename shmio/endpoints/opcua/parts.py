"""Parts of values, which clients name by index ranges (OPC 10000-4, section 7.27)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.ua.ua_binary import struct_to_binary

from shmio.endpoints.opcua.feed import Readable
from shmio.endpoints.opcua.nodes import RegisterNode
from shmio.endpoints.opcua.values import data_type
from shmio.errors import PathError
from shmio.layout.model import Register
from shmio.layout.topic import find, names_part
from shmio.layout.values import index_range
from shmio.layout.values.index_range import NoDataError, Ranges, ShapeError, sizes_of
from shmio.model.opcua_parts import read_part

Fault: Final = ua.StatusCodes
_TEXTS: Final = ("STRING", "WSTRING")


def check_range(text: str) -> None:
    """Raise ServiceError if a text is no index range."""
    try:
        index_range.parse(text)
    except ValueError:
        raise ServiceError(Fault.BadIndexRangeInvalid) from None


class PartOfVariable:
    """A part of a variable's value, which clients monitor."""

    def __init__(self, whole: Readable, text: str) -> None:
        self._whole, self._text = whole, text

    def is_missing(self) -> bool:
        """Return whether the variable has a value, and nothing in this part of it."""
        status = self.value().StatusCode
        return status is not None and status.value == Fault.BadIndexRangeNoData

    def value(self) -> ua.DataValue:
        """Return the present value."""
        return read_part(self._whole.value(), self._text)

    def encoded(self) -> bytes:
        """Return the present value, encoded."""
        return struct_to_binary(self.value())


def plain(given: ua.Variant | None, register: Register) -> Any:
    """Return the value of a variant, or None if its type does not fit the register."""
    if given is None or given.Value is None:
        return None
    if register.dims and given.VariantType == ua.VariantType.ByteString and data_type(register) == ua.VariantType.Byte:
        return list(given.Value)
    if given.VariantType != data_type(register) or bool(given.is_array) != bool(register.dims):
        return None
    return given.Value


def registers_of_part(node: RegisterNode, text: str, given: ua.Variant | None) -> Mapping[Register, Any]:
    """Return the slices that an index range names, with a value for each; None for a value of another type.

    In a text, a range names characters, and the register can be written only as a whole. So the value of the
    newest frame fills the rest, and what another program writes there at the same time is lost.

    Raises:
        ServiceError: The text is no index range, the register has not all of it, or the value has another shape.
    """
    register = node.register
    check_range(text)
    ranges = index_range.parse(text)
    value = plain(given, register)
    if value is None:
        return {register: None}
    try:
        if not register.dims and register.element.base in _TEXTS:
            present = node.value().Value
            if present is None or present.Value is None:
                raise ServiceError(Fault.BadNoDataAvailable)
            return {register: index_range.replace(present.Value, ranges, value)}
        if len(ranges) != len(register.dims):
            raise ServiceError(Fault.BadIndexRangeNoData)
        return dict(_slices(node, ranges, value))
    except NoDataError:
        raise ServiceError(Fault.BadIndexRangeNoData) from None
    except ShapeError:
        raise ServiceError(Fault.BadIndexRangeDataMismatch) from None


def _slices(node: RegisterNode, ranges: Ranges, value: Any) -> Iterator[tuple[Register, Any]]:
    """Yield the parts of rows that ranges name in an array, with their values."""
    register = node.register
    for (first, last), (low, high) in zip(ranges, register.dims, strict=True):
        if low + last > high or first > last:
            raise NoDataError
    if sizes_of(value) != [last - first + 1 for first, last in ranges] or not _is_regular(value, ranges):
        raise ShapeError
    # A slice is named by the array that it is part of, and has that array's indices.
    head = register.path.rpartition("/")[0] if names_part(register.path) else register.path
    starts = [low + first for (first, _), (low, _) in zip(ranges, register.dims, strict=True)]
    counts = [last - first + 1 for first, last in ranges]
    for row in product(*map(range, counts[:-1])):
        leading = (str(start + step) for start, step in zip(starts, row, strict=False))
        path = "/".join((head, *leading, f"{starts[-1]}..{starts[-1] + counts[-1] - 1}"))
        part = value
        for step in row:
            part = part[step]
        try:
            yield find(node.feed.block.layout, path), part
        except PathError:
            raise NoDataError from None


def _is_regular(value: Any, ranges: Ranges) -> bool:
    (first, last), rest = ranges[0], ranges[1:]
    if not isinstance(value, list) or len(value) != last - first + 1:
        return False
    return all(_is_regular(one, rest) for one in value) if rest else not any(isinstance(one, list) for one in value)
