"""Export frames as tables, CSV or Parquet: a row for each frame."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from shmio.layout.model import Register
from shmio.recording.columns import Columns, flat, heading
from shmio.recording.libraries import ANALYSIS, library
from shmio.recording.names import Chosen
from shmio.recording.reading.blocks import DumpBlock
from shmio.recording.rewriting import new_file
from shmio.segment import Provenance, Quality

HEADINGS = ("time", "number", "cycle", "quality", "provenance")


class CsvTable:
    """A CSV file with a column for each register and each element of an array.

    Times are in UTC, and durations are numbers in the unit of their type. A cell is empty if the
    bytes are no value of the type, or if the source never had a value.
    """

    def __init__(self, stream: IO[bytes], registers: Sequence[Register]) -> None:  # noqa: ARG002  as all tables
        self.rows = 0
        self._text = io.TextIOWrapper(stream, "utf-8", newline="", write_through=True)
        self._writer = csv.writer(self._text)

    def write(self, columns: Columns) -> None:
        """Write the next rows."""
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
        """Flush the text. The stream stays open."""
        self._text.flush()
        self._text.detach()


def texts(values: npt.NDArray[Any], suffix: str = "") -> list[Any]:
    """Convert values for CSV: floats in the fewest digits that read back to the same value."""
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


GROUP_BYTES: Final = 16 << 20
"""Approximate size of a row group. Each one costs some hundred bytes of memory a column until the file is closed."""


class ParquetTable:
    """A Parquet file, compressed with zstd; columns as of ``Columns.to_arrow``."""

    def __init__(self, stream: IO[bytes], registers: Sequence[Register]) -> None:  # noqa: ARG002  as all tables
        """MissingLibraryError: pyarrow is not installed."""
        self.rows = 0
        self._arrow = library("pyarrow", ANALYSIS)
        self._parquet = library("pyarrow.parquet", ANALYSIS)
        self._stream = stream
        self._writer: Any = None
        self._waiting: list[Any] = []
        """Tables that together become the next row group."""

    def write(self, columns: Columns) -> None:
        """Write the next rows."""
        table = columns.to_arrow()
        if self._writer is None:
            self._writer = self._parquet.ParquetWriter(self._stream, table.schema, compression="zstd")
        self._waiting.append(table)
        self.rows += len(columns.time_ns)
        if sum(waiting.nbytes for waiting in self._waiting) >= GROUP_BYTES:
            self._write_group()

    def _write_group(self) -> None:
        if self._waiting:
            self._writer.write_table(self._arrow.concat_tables(self._waiting))
            self._waiting = []

    def close(self) -> None:
        """Write the last row group and the footer."""
        if self._writer is not None:
            self._write_group()
            self._writer.close()


class Table(Protocol):
    """A file with a row for each frame of a block."""

    rows: int

    def write(self, columns: Columns) -> None:
        """Write the next rows."""

    def close(self) -> None:
        """Complete the file."""


TABLES: dict[str, Callable[[IO[bytes], Sequence[Register]], Table]] = {"parquet": ParquetTable, "csv": CsvTable}


@contextmanager
def new_folder(path: Path) -> Iterator[None]:
    """Create a folder and its parents if they do not exist; on an error remove those created."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with suppress(OSError):  # the folder is not empty: others have put something into it
            for folder in made:
                folder.rmdir()
        raise


class BlockTables:
    """Writes a file for each block, named after its source; further blocks of a source are numbered."""

    def __init__(self, stack: ExitStack, output: Path, form: str, chosen: Chosen, *, named: bool) -> None:
        """``named``: whether ``output`` is the only file and not a folder for several."""
        self._stack = stack
        self._output = output
        self._form = form
        self._chosen = chosen
        self._named = named
        self._tables: dict[DumpBlock, tuple[Path, Table]] = {}

    def write(self, block: DumpBlock, columns: Columns) -> None:
        """Write the next rows of a block."""
        if block not in self._tables:
            if not self._named and not self._tables:
                self._stack.enter_context(new_folder(self._output))
            path = self._path(block)
            stream = self._stack.enter_context(new_file(path))
            table = TABLES[self._form](stream, self._chosen[block])
            self._stack.callback(table.close)  # before its file is closed, even if that is removed then
            self._tables[block] = path, table
        self._tables[block][1].write(columns)

    def _path(self, block: DumpBlock) -> Path:
        if self._named:
            return self._output
        number = 1 + sum(other.source == block.source for other in self._tables)
        return self._output / f"{block.source}{f'-{number}' if number > 1 else ''}.{self._form}"

    @property
    def files(self) -> list[tuple[Path, int]]:
        """Path and rows of each file."""
        return [(path, table.rows) for path, table in self._tables.values()]
