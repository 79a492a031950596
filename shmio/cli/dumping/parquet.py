"""Apache Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import IO, Any

from shmio.dump.columns import Columns
from shmio.dump.libraries import ANALYSIS, library
from shmio.layout.model import Register


class ParquetTable:
    """A file with a row for each frame: columns as of ``arrow.py``, compressed with zstd."""

    def __init__(self, stream: IO[bytes], registers: Sequence[Register]) -> None:  # noqa: ARG002  as all tables
        """MissingLibraryError."""
        self.rows = 0
        library("pyarrow", ANALYSIS)
        self._parquet = library("pyarrow.parquet", ANALYSIS)
        self._stream = stream
        self._writer: Any = None

    def write(self, columns: Columns) -> None:
        """The next rows, as a row group."""
        table = columns.to_arrow()
        if self._writer is None:
            self._writer = self._parquet.ParquetWriter(self._stream, table.schema, compression="zstd")
        self._writer.write_table(table)
        self.rows += len(columns.time_ns)

    def close(self) -> None:
        """Write the footer."""
        if self._writer is not None:
            self._writer.close()
