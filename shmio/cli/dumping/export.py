"""``shmio-dump export``: recordings for other programs."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Protocol

from shmio.cli.dumping.complaints import Complaints
from shmio.cli.dumping.csvfile import CsvTable
from shmio.cli.dumping.moments import span, time_range
from shmio.cli.dumping.parquet import ParquetTable
from shmio.cli.dumping.progress import Progress
from shmio.cli.dumping.rewriting import new_file
from shmio.cli.dumping.viewer import export_mcap
from shmio.cli.run import say
from shmio.dump.blocks import DumpBlock
from shmio.dump.columns import Columns
from shmio.dump.dump import Dump
from shmio.dump.names import Chosen
from shmio.dump.pieces import pieces
from shmio.errors import PathError, RecordingError
from shmio.layout.model import Register


class Table(Protocol):
    """A file with a row for each frame of a block."""

    rows: int

    def write(self, columns: Columns) -> None:
        """The next rows."""

    def close(self) -> None:
        """No more rows."""


TABLES: dict[str, Callable[[IO[bytes], Sequence[Register]], Table]] = {"parquet": ParquetTable, "csv": CsvTable}


def execute(arguments: argparse.Namespace) -> int:
    """Write tables, a file for each block, or one MCAP file for viewers."""
    complaints = Complaints()
    with (
        complaints.open(arguments.files) as dump,
        Progress(f"exporting to {arguments.output}") as progress,
    ):
        from_ns, to_ns = time_range(arguments, dump.begin_ns)
        chosen = _chosen(dump, arguments)
        if not chosen:
            raise RecordingError(f"{dump.files[0]}: nothing is recorded in it")
        sources = list(dict.fromkeys(block.source for block in chosen))
        if arguments.format == "mcap":
            progress.total = dump.end_ns - dump.begin_ns
            with new_file(arguments.output) as stream:
                counts = export_mcap(dump, chosen, stream, from_ns, to_ns, raw=arguments.raw, progress=progress)
            say(f"{arguments.output}: {counts} messages")
            return int(complaints.any)
        progress.total = len(sources) * (dump.end_ns - dump.begin_ns)
        with ExitStack() as stack:
            tables = _Tables(stack, arguments.output, TABLES[arguments.format], arguments.format, chosen)
            for place, source in enumerate(sources):
                for block, columns in pieces(dump, source, chosen, from_ns, to_ns, raw=arguments.raw):
                    tables.write(block, columns)
                    past = int(columns.time_ns[-1]) - dump.begin_ns
                    progress.at(place * (dump.end_ns - dump.begin_ns) + past)
            files = tables.close()
        if not files:
            raise RecordingError(
                f"no frames of {dump.files[0]} are in that time; it goes {span(dump.begin_ns, dump.end_ns)}"
            )
    for path, rows in files:
        say(f"{path}: {rows} rows")
    return int(complaints.any)


def _chosen(dump: Dump, arguments: argparse.Namespace) -> Chosen:
    if arguments.only:
        chosen = dump.select(arguments.only)
    else:
        chosen = {block: list(block.layout.registers) for block in dump.blocks}
    for source in arguments.sources or ():
        if source not in dump.sources:
            raise PathError(f"no source {source!r}; there are: {', '.join(dump.sources)}")
    return {block: some for block, some in chosen.items() if not arguments.sources or block.source in arguments.sources}


class _Tables:
    """A file for each block, named after its source; further blocks of it are numbered."""

    def __init__(
        self,
        stack: ExitStack,
        directory: Path,
        make: Callable[[IO[bytes], Sequence[Register]], Table],
        suffix: str,
        chosen: Chosen,
    ) -> None:
        self._stack = stack
        self._directory = directory
        self._make = make
        self._suffix = suffix
        self._chosen = chosen
        self._tables: dict[DumpBlock, tuple[Path, Table]] = {}

    def write(self, block: DumpBlock, columns: Columns) -> None:
        if block not in self._tables:
            self._directory.mkdir(parents=True, exist_ok=True)
            number = 1 + sum(other.source == block.source for other in self._tables)
            path = self._directory / f"{block.source}{f'-{number}' if number > 1 else ''}.{self._suffix}"
            stream = self._stack.enter_context(new_file(path))
            self._tables[block] = path, self._make(stream, self._chosen[block])
        self._tables[block][1].write(columns)

    def close(self) -> list[tuple[Path, int]]:
        """Path and rows of each file."""
        for _, table in self._tables.values():
            table.close()
        return [(path, table.rows) for path, table in self._tables.values()]
