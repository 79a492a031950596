"""Convert columns to an Apache Arrow table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from shmio.recording.columns import heading
from shmio.recording.libraries import ANALYSIS, library

if TYPE_CHECKING:
    import pyarrow

    from shmio.recording.columns import Columns


def table(columns: Columns) -> pyarrow.Table:
    """Convert columns to a table: time (UTC, ns), source time, number, cycle, quality, provenance, registers.

    Types are native: arrays are lists of fixed size, POINTER and ANY are bytes. Null means that the bytes
    are no value of the type, or that the source never had an image. A register with the name of another
    column is prefixed by its source.

    Raises:
        MissingLibraryError: pyarrow is not installed.
    """
    arrow = library("pyarrow", ANALYSIS)
    unknown = columns.source_ns == 0
    time = arrow.timestamp("ns", "UTC")
    fields = {
        "time": arrow.array(columns.time_ns).cast(time),
        "source_time": arrow.array(columns.source_ns, mask=unknown).cast(time),
        "number": arrow.array(columns.number),
        "cycle": arrow.array(columns.cycle),
        "quality": _named(arrow, columns.quality, ("bad", "uncertain", "good")),
        "provenance": _named(arrow, columns.provenance, ("live", "simulated", "replayed", "injected")),
    }
    for path, values in columns.items():
        fields[heading(columns.source, path)] = _nested(arrow, values, unknown)
    return arrow.Table.from_arrays(list(fields.values()), names=list(fields))


def _named(arrow: Any, codes: npt.NDArray[np.uint8], names: tuple[str, ...]) -> Any:
    known = np.where(codes < len(names), codes, 0).astype(np.int8)  # unknown codes count as the first name
    return arrow.DictionaryArray.from_arrays(arrow.array(known), arrow.array(names))


def _nested(arrow: Any, values: npt.NDArray[Any], unknown: npt.NDArray[np.bool_]) -> Any:
    """Convert values of shape (n, …) to an array of n values or nested lists."""
    mask = np.repeat(unknown, values[0].size) if len(values) and values.ndim > 1 else unknown
    plain = np.ascontiguousarray(values).reshape(-1)
    if plain.dtype.kind in "mM":
        mask = mask | np.isnat(plain)
    if plain.dtype.kind == "V":
        size = plain.dtype.itemsize
        hidden = [None if hide else bytes(value) for value, hide in zip(plain, mask, strict=True)]
        found = arrow.array(hidden, arrow.binary(size))
    elif plain.dtype.kind == "U":
        found = arrow.array(plain.tolist(), arrow.string(), mask=mask)
    else:
        found = arrow.array(plain, mask=mask)
    for length in reversed(values.shape[1:]):
        found = arrow.FixedSizeListArray.from_arrays(found, length)
    return found
