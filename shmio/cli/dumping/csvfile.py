"""CSV (RFC 4180)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from shmio.dump.columns import Columns, flat, heading
from shmio.layout.model import Register
from shmio.segment import Provenance, Quality

HEADINGS = ("time", "number", "cycle", "quality", "provenance")


class CsvTable:
    """A row for each frame, a column for each register and each element of an array.

    Times in UTC, durations as numbers of their type's unit; empty: no value of its type, or the source never had one.
    """

    def __init__(self, stream: IO[bytes], registers: Sequence[Register]) -> None:  # noqa: ARG002  the columns tell
        self.rows = 0
        self._text = io.TextIOWrapper(stream, "utf-8", newline="", write_through=True)
        self._writer = csv.writer(self._text)

    def write(self, columns: Columns) -> None:
        """The next rows."""
        names, values = list(HEADINGS), [
            texts(columns.time_ns.view("M8[ns]"), "Z"),
            columns.number.tolist(),
            columns.cycle.tolist(),
            [str(Quality(min(code, Quality.GOOD))) for code in columns.quality.tolist()],
            [str(Provenance(code)) for code in columns.provenance.tolist()],
        ]  # fmt: skip
        unknown = columns.source_ns == 0
        for register in columns.registers:
            for name, column in flat(register, columns[register.path]):
                names.append(heading(columns.source, name))
                shown = texts(column)
                if unknown.any():
                    shown = ["" if hide else text for text, hide in zip(shown, unknown.tolist(), strict=True)]
                values.append(shown)
        if not self.rows:
            self._writer.writerow(names)
        self._writer.writerows(zip(*values, strict=True))
        self.rows += len(columns.time_ns)

    def close(self) -> None:
        """Everything is written."""
        self._text.flush()
        self._text.detach()


def texts(values: npt.NDArray[Any], suffix: str = "") -> list[Any]:
    """Values as CSV has them: floats in the fewest digits that read back to the same value of their type."""
    kind = values.dtype.kind
    if kind == "b":
        values = np.where(values, "true", "false")
    elif kind == "f":
        values = values.astype(str)
    if kind == "m":
        numbers = values.astype(np.int64).tolist()
        return ["" if gone else number for number, gone in zip(numbers, np.isnat(values).tolist(), strict=True)]
    if kind == "M":
        moments = np.datetime_as_string(values).tolist()
        return ["" if moment == "NaT" else f"{moment}{suffix}" for moment in moments]
    return list(values.tolist())
