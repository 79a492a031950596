"""Apache Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import IO, Any, Final

from shmio.dump.columns import Columns
from shmio.dump.libraries import ANALYSIS, library
from shmio.layout.model import Register

GROUP_BYTES: Final = 16 << 20
"""A row group has about so many bytes of values: each costs some hundred bytes a column until the file is closed."""


class ParquetTable:
    """A file with a row for each frame: columns as of ``arrow.py``, compressed with zstd."""

    def __init__(self, stream: IO[bytes], registers: Sequence[Register]) -> None:  # noqa: ARG002  as all tables
        """MissingLibraryError."""
        self.rows = 0
        self._arrow = library("pyarrow", ANALYSIS)
        self._parquet = library("pyarrow.parquet", ANALYSIS)
        self._stream = stream
        self._writer: Any = None
        self._waiting: list[Any] = []
        """Tables that make the next row group together."""

    def write(self, columns: Columns) -> None:
        """The next rows."""
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
        """Write what waits, and the footer."""
        if self._writer is not None:
            self._write_group()
            self._writer.close()
