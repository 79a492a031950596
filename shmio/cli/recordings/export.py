"""``shmio-dump export``: recordings for other programs."""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from shmio.cli.recordings.damage_report import DamageReport
from shmio.cli.recordings.event_table import export_events
from shmio.cli.recordings.progress import Progress
from shmio.cli.recordings.rewriting import new_file
from shmio.cli.recordings.times import span, time_range
from shmio.cli.recordings.viewer import export_mcap
from shmio.cli.run import dumps, say
from shmio.errors import PathError, RecordingError
from shmio.layout.model import Register
from shmio.recording.columns import Columns, flat, heading
from shmio.recording.dump import Dump
from shmio.recording.format.blocks import DumpBlock
from shmio.recording.libraries import ANALYSIS, library
from shmio.recording.names import Chosen
from shmio.recording.pieces import pieces
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


class Table(Protocol):
    """A file with a row for each frame of a block."""

    rows: int

    def write(self, columns: Columns) -> None:
        """The next rows."""

    def close(self) -> None:
        """No more rows."""


TABLES: dict[str, Callable[[IO[bytes], Sequence[Register]], Table]] = {"parquet": ParquetTable, "csv": CsvTable}
FORMATS: Final = (*TABLES, "mcap")
SHEETS: Final = frozenset({"ods", "xls", "xlsx"})
OTHERS: Final = frozenset(
    {"arrow", "db", "duckdb", "feather", "h5", "hdf5", "json", "jsonl", "mat", "mem", "tsv", "txt"}
)
"""A folder with such a name is not meant."""


def execute(arguments: argparse.Namespace) -> int:
    """Write tables, a file for each block, or one MCAP file for viewers."""
    report = DamageReport()
    named, form = _form(arguments.output, arguments.format)
    if arguments.events and (not named or form not in TABLES):
        raise RecordingError(f"{arguments.output}: --events makes one table: have its name end in .csv or .parquet")
    with (
        report.open(arguments.files) as dump,
        Progress(f"exporting to {arguments.output}") as progress,
    ):
        from_ns, to_ns = time_range(arguments, dump.begin_ns)
        chosen = _chosen(dump, arguments)
        if not chosen:
            raise RecordingError(f"{dump.files[0]}: nothing is recorded in it")
        sources = list(dict.fromkeys(block.source for block in chosen))
        if arguments.events:
            progress.total = dump.end_ns - dump.begin_ns
            with new_file(arguments.output) as stream:
                count = export_events(dump, sources, stream, form, from_ns, to_ns, progress)
            return _print_result(arguments, report, [(arguments.output, count)], "rows")
        if form == "mcap":
            progress.total = dump.end_ns - dump.begin_ns
            with new_file(arguments.output) as stream:
                counts = export_mcap(dump, chosen, stream, from_ns, to_ns, raw=arguments.raw, progress=progress)
            return _print_result(arguments, report, [(arguments.output, counts)], "messages")
        progress.total = len(sources) * (dump.end_ns - dump.begin_ns)
        with ExitStack() as stack:
            if named:
                _require_one(arguments.output, [block for block in chosen if _within(block, from_ns, to_ns)])
            tables = _Tables(stack, arguments.output, form, chosen, named=named)
            for place, source in enumerate(sources):
                for block, columns in pieces(dump, source, chosen, from_ns, to_ns, raw=arguments.raw):
                    tables.write(block, columns)
                    past = int(columns.time_ns[-1]) - dump.begin_ns
                    progress.at(place * (dump.end_ns - dump.begin_ns) + past)
        if not tables.files:
            raise RecordingError(
                f"no frames of {dump.files[0]} are in that time; it goes {span(dump.begin_ns, dump.end_ns)}"
            )
    return _print_result(arguments, report, tables.files, "rows")


def _print_result(
    arguments: argparse.Namespace, report: DamageReport, files: Sequence[tuple[Path, int]], what: str
) -> int:
    """Print what was made, as lines or an object; 1 if something was damaged."""
    if arguments.json:
        made = [{"file": str(path), what: count} for path, count in files]
        print(dumps({"files": made, "damage": report.texts}, indent=2))
    else:
        for path, count in files:
            say(f"{path}: {count} {what}")
    return int(report.any)


def _form(output: Path, asked: str | None) -> tuple[bool, str]:
    """(whether the name is that of a file of some format, the format); RecordingError: it is of another."""
    suffix = output.suffix.lower().removeprefix(".")
    if suffix in SHEETS | OTHERS and not output.is_dir():
        raise RecordingError(f"{output}: export does not write .{suffix}; {_remedy(output, suffix)}")
    if suffix not in FORMATS or output.is_dir():
        return False, asked or "parquet"
    if asked not in (None, suffix):
        raise RecordingError(f"{output}: as its name ends it is not --format {asked}; leave out one of them")
    return True, suffix


def _remedy(output: Path, suffix: str) -> str:
    if suffix in SHEETS:
        return f"-o {output.with_suffix('.csv')} makes a file that Excel and LibreOffice open"
    if suffix == "mem":
        return f"shmio-dump cut FILE… -o {output} writes a part of a recording to a new one"
    formats = ", ".join(f".{form}" for form in FORMATS)
    return f"it writes {formats}, by the end of the name, or into a folder by --format"


def _within(block: DumpBlock, from_ns: int, to_ns: int) -> bool:
    return bool(block.frames) and block.first_ns <= to_ns and block.last_ns >= from_ns


def _require_one(output: Path, blocks: Sequence[DumpBlock]) -> None:
    """RecordingError: these blocks do not go into one table."""
    if len(blocks) > 1:
        names = ", ".join(block.source for block in blocks)
        raise RecordingError(f"{output} holds one block, and there are {len(blocks)} ({names}): name a folder")


def _chosen(dump: Dump, arguments: argparse.Namespace) -> Chosen:
    if arguments.only:
        chosen = dump.select(arguments.only)
    else:
        chosen = {block: list(block.layout.registers) for block in dump.blocks}
    for source in arguments.sources or ():
        if source not in dump.sources:
            raise PathError(f"no source {source!r}; there are: {', '.join(dump.sources)}")
    return {block: some for block, some in chosen.items() if not arguments.sources or block.source in arguments.sources}


@contextmanager
def _folder(path: Path) -> Iterator[None]:
    """A folder, made if need be; what was made is removed again unless all goes well."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with suppress(OSError):  # others have put something into it
            for folder in made:
                folder.rmdir()
        raise


class _Tables:
    """A file for each block, named after its source; further blocks of it are numbered."""

    def __init__(self, stack: ExitStack, output: Path, form: str, chosen: Chosen, *, named: bool) -> None:
        """``named``: ``output`` is the name of the only file, not their folder."""
        self._stack = stack
        self._output = output
        self._form = form
        self._chosen = chosen
        self._named = named
        self._tables: dict[DumpBlock, tuple[Path, Table]] = {}

    def write(self, block: DumpBlock, columns: Columns) -> None:
        if block not in self._tables:
            if not self._named and not self._tables:
                self._stack.enter_context(_folder(self._output))
            path = self._path(block)
            stream = self._stack.enter_context(new_file(path))
            table = TABLES[self._form](stream, self._chosen[block])
            self._stack.callback(table.close)  # before its file is, also where that is then removed
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
