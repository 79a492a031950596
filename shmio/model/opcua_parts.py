"""Parts of OPC UA values, which clients name by index ranges. This module needs the library asyncua."""

from __future__ import annotations

from typing import Final

from asyncua import ua

from shmio.layout.values import index_range
from shmio.layout.values.index_range import NoDataError, sizes_of

Fault: Final = ua.StatusCodes


def read_part(value: ua.DataValue, text: str) -> ua.DataValue:
    """Return the part of a value that an index range selects; a bad status if there is none."""
    try:
        ranges = index_range.parse(text)
    except ValueError:
        return _bad(Fault.BadIndexRangeInvalid)
    if value.Value is None or value.Value.Value is None:
        is_bad = value.StatusCode is not None and value.StatusCode.is_bad()
        return value if is_bad else _bad(Fault.BadIndexRangeNoData)
    try:
        part = index_range.select(value.Value.Value, ranges)
    except NoDataError:
        return _bad(Fault.BadIndexRangeNoData)
    array = isinstance(part, list)
    sizes = sizes_of(part)
    found = ua.Variant(part, value.Value.VariantType, sizes if len(sizes) > 1 else None, is_array=array)
    return ua.DataValue(found, value.StatusCode, value.SourceTimestamp, value.ServerTimestamp)


def write_part(value: ua.DataValue, text: str, given: ua.DataValue) -> ua.DataValue | int:
    """Return a value in which an index range has the contents of another; the status if it cannot have them."""
    present, new = value.Value, given.Value
    if present is None or present.Value is None:
        return Fault.BadIndexRangeNoData
    if new is None or new.VariantType != present.VariantType:
        return Fault.BadTypeMismatch
    try:
        whole = index_range.replace(present.Value, index_range.parse(text), new.Value)
    except NoDataError:
        return Fault.BadIndexRangeNoData
    except index_range.ShapeError:
        return Fault.BadIndexRangeDataMismatch
    except ValueError:
        return Fault.BadIndexRangeInvalid
    variant = ua.Variant(whole, present.VariantType, present.Dimensions, is_array=present.is_array)
    return ua.DataValue(variant, given.StatusCode, given.SourceTimestamp, given.ServerTimestamp)


def _bad(code: int) -> ua.DataValue:
    return ua.DataValue(StatusCode=ua.StatusCode(code))
