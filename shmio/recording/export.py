"""Exports recordings for other programs: as tables (CSV, Parquet), or as MCAP files with JSON."""

from __future__ import annotations

import csv
import heapq
import io
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from shmio.layout.model import Register
from shmio.libraries import ANALYSIS, library
from shmio.recording.columns import Collector, Columns, flat, heading
from shmio.recording.dump import Chosen, Dump
from shmio.recording.format.mcap_writer import McapWriter
from shmio.recording.reading.part import MAX_NS, DumpBlock
from shmio.recording.rewriting import new_file
from shmio.recording.times import iso
from shmio.segment import Provenance, Quality
from shmio.segment.explain import Explainer, cells_of, kind_of, object_of
from shmio.version import __version__

PIECE_BYTES: Final = 8 << 20
"""Approximate size in memory of each piece that :func:`pieces` yields, in bytes."""
GROUP_BYTES: Final = 16 << 20
"""Approximate size in bytes of a row group of a Parquet file.

Each row group takes some hundred bytes of memory per column until the file is closed.
"""

_HEADINGS: Final = ("time", "number", "cycle", "quality", "provenance")
_EVENT_NUMBERS: Final = ("frame", "cycle", "injection", "command", "item", "items", "offset", "mask", "size")
_EVENT_COLUMNS: Final = (
    "time", "source", "number", "kind", "quality", "path", "value", "direction", "by", "text", *_EVENT_NUMBERS, "data",
)  # fmt: skip
_EVENT_BATCH: Final = 4096
_FRAME: Final = "frame"
_FRAME_FIELDS: Final = {"number": "integer", "cycle": "integer", "quality": "integer", "provenance": "integer"}
"""The header fields of a frame that a JSON message has, with their JSON types.

In the message, they are in the object ``frame``.
"""
_JSON_TYPES: Final = {"b": "boolean", "i": "integer", "u": "integer", "f": "number", "m": "integer"}
_EVENT_TYPES: Final = {
    "kind": "string", "text": "string", "quality": "string", "number": "integer", "frame": "integer",
    "cycle": "integer", "by": "string", "direction": "string", "paths": "array", "values": "object",
    "laid": "object", "injection": "integer", "command": "integer", "item": "integer", "items": "integer",
    "offset": "integer", "mask": "integer", "size": "integer", "data": "string",
}  # fmt: skip


def pieces(
    dump: Dump,
    source: str,
    chosen: Mapping[DumpBlock, Sequence[Register]],
    from_ns: int = 0,
    to_ns: int = MAX_NS,
    *,
    raw: bool = False,
) -> Iterator[tuple[DumpBlock, Columns]]:
    """Yield the values of registers of one source in pieces, each from one block.

    Args:
        dump: The recording.
        source: Name of the source.
        chosen: The registers, by block.
        from_ns: Start of the range, log time in ns.
        to_ns: End of the range, log time in ns.
        raw: True for the values that the source delivered, without injections; False for the values
            that readers saw.

    Raises:
        PathError: There is no such source.
        RecordingError: A part of the recording cannot be read.
    """
    collector, of = Collector(source), None
    for block, batch in dump.batches(source, from_ns, to_ns, raw=raw):
        if block not in chosen:
            continue
        if of is not None and (block is not of or collector.bytes >= PIECE_BYTES):
            yield of, collector.columns()
        if block is not of:
            collector, of = Collector(source), block
        collector.add(block, chosen[block], batch)
    if of is not None:
        yield of, collector.columns()


class CsvTable:
    """A CSV file with a column for each register or, for an array, for each element.

    Times are in UTC. Durations are numbers in the unit of their type. A cell is empty if the
    register's bytes are not a valid value, or if the source had no value yet.
    """

    def __init__(self, stream: IO[bytes], registers: Sequence[Register]) -> None:  # noqa: ARG002  all tables take it
        self.rows = 0
        self._text = io.TextIOWrapper(stream, "utf-8", newline="", write_through=True)
        self._writer = csv.writer(self._text)

    def write(self, columns: Columns) -> None:
        """Write the next rows."""
        names, values = list(_HEADINGS), [
            _texts(columns.time_ns.view("M8[ns]"), "Z"),
            columns.number.tolist(),
            columns.cycle.tolist(),
            [str(Quality(min(code, Quality.GOOD))) for code in columns.quality.tolist()],
            [str(Provenance(code)) for code in columns.provenance.tolist()],
        ]  # fmt: skip
        unknown = columns.source_ns == 0
        for register in columns.registers:
            for name, column in flat(register, columns[register.path]):
                names.append(heading(columns.source, name))
                shown = _texts(column)
                if unknown.any():
                    shown = ["" if hide else text for text, hide in zip(shown, unknown.tolist(), strict=True)]
                values.append(shown)
        if not self.rows:
            self._writer.writerow(names)
        self._writer.writerows(zip(*values, strict=True))
        self.rows += len(columns.time_ns)

    def close(self) -> None:
        """Write the buffered text to the stream, which stays open."""
        self._text.flush()
        self._text.detach()


def _texts(values: npt.NDArray[Any], suffix: str = "") -> list[Any]:
    """Convert values for CSV.

    A float has the fewest digits from which the same value can be read.
    """
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


class ParquetTable:
    """A Parquet file, compressed with zstd, with the columns of :meth:`Columns.to_arrow`."""

    def __init__(self, stream: IO[bytes], registers: Sequence[Register]) -> None:  # noqa: ARG002  all tables take it
        """Create the table.

        Raises:
            MissingLibraryError: pyarrow is not installed.
        """
        self.rows = 0
        self._arrow = library("pyarrow", ANALYSIS)
        self._parquet = library("pyarrow.parquet", ANALYSIS)
        self._stream = stream
        self._writer: Any = None
        self._waiting: list[Any] = []
        """The tables that will become the next row group."""

    def write(self, columns: Columns) -> None:
        """Write the next rows."""
        table = columns.to_arrow()
        if self._writer is None:
            self._writer = self._parquet.ParquetWriter(self._stream, table.schema, compression="zstd")
        self._waiting.append(table)
        self.rows += len(columns.time_ns)
        if self.waiting_bytes >= GROUP_BYTES:
            self.flush()

    @property
    def waiting_bytes(self) -> int:
        """Size in memory of the rows that are not written to the stream yet."""
        return sum(int(waiting.nbytes) for waiting in self._waiting)

    def flush(self) -> None:
        """Write all rows so far to the stream, as a row group."""
        if self._waiting:
            self._writer.write_table(self._arrow.concat_tables(self._waiting))
            self._waiting = []

    def close(self) -> None:
        """Write the last row group and the footer."""
        if self._writer is not None:
            self.flush()
            self._writer.close()


class Table(Protocol):
    """A file that gets a row for each frame of a block."""

    rows: int

    def write(self, columns: Columns) -> None:
        """Write the next rows."""

    def close(self) -> None:
        """Write the rest of the file."""


TABLES: dict[str, Callable[[IO[bytes], Sequence[Register]], Table]] = {"parquet": ParquetTable, "csv": CsvTable}


@contextmanager
def _new_folder(path: Path) -> Iterator[None]:
    """Create a folder and its missing parents. After an error, remove those that were created."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with suppress(OSError):  # the folder is not empty: another program has written to it
            for folder in made:
                folder.rmdir()
        raise


class BlockTables:
    """Writes a file with a table for each block.

    A file has the name of its source. If a source has several blocks, the names of all files but the
    first also have a number.
    """

    def __init__(self, stack: ExitStack, output: Path, form: str, chosen: Chosen, *, named: bool) -> None:
        """Create the writer.

        ``output`` is the only file if ``named`` is set; otherwise it is a folder.
        """
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
                self._stack.enter_context(_new_folder(self._output))
            path = self._path(block)
            stream = self._stack.enter_context(new_file(path))
            table = TABLES[self._form](stream, self._chosen[block])
            self._stack.callback(table.close)  # closes the table before its file, even if the file is then removed
            self._tables[block] = path, table
        self._tables[block][1].write(columns)

    def _path(self, block: DumpBlock) -> Path:
        if self._named:
            return self._output
        number = 1 + sum(other.source == block.source for other in self._tables)
        return self._output / f"{block.source}{f'-{number}' if number > 1 else ''}.{self._form}"

    @property
    def files(self) -> list[tuple[Path, int]]:
        """The path and the number of rows of each file."""
        return [(path, table.rows) for path, table in self._tables.values()]


def export_events(
    dump: Dump,
    sources: Collection[str],
    stream: IO[bytes],
    form: str,
    from_ns: int,
    to_ns: int,
    progress: Callable[[int], None],
) -> int:
    """Write a table with a row for each event of some sources.

    Args:
        dump: The recording.
        sources: Names of the sources.
        stream: The new file.
        form: ``csv`` or ``parquet``.
        from_ns: Start of the range, log time in ns.
        to_ns: End of the range, log time in ns.
        progress: Called with the time in ns, from the start of the recording, up to which it is
            done.

    Returns:
        The number of rows.

    Raises:
        MissingLibraryError: pyarrow is not installed.
    """
    rows = _event_rows(dump, sources, from_ns, to_ns, progress)
    return _events_to_parquet(stream, rows) if form == "parquet" else _events_to_csv(stream, rows)


def _event_rows(
    dump: Dump, sources: Collection[str], from_ns: int, to_ns: int, progress: Callable[[int], None]
) -> Iterator[tuple[Any, ...]]:
    """Yield a row with the columns of _EVENT_COLUMNS for each event. Times are in ns."""
    explainers: dict[DumpBlock, Explainer] = {}
    for time_ns, block, event in dump.events(sources, from_ns, to_ns):
        if block is None:
            continue
        if block not in explainers:
            explainers[block] = Explainer(block.source, block.layout)
        about = cells_of(explainers[block].explain(event))
        head = time_ns, block.source, event.number, kind_of(event), str(event.quality)
        yield *head, *about, event.text, *(getattr(event, name) for name in _EVENT_NUMBERS), event.data.hex()
        progress(time_ns - dump.begin_ns)


def _events_to_csv(stream: IO[bytes], rows: Iterator[tuple[Any, ...]]) -> int:
    text = io.TextIOWrapper(stream, "utf-8", newline="", write_through=True)
    writer = csv.writer(text)
    writer.writerow(_EVENT_COLUMNS)
    count = 0
    for time_ns, *rest in rows:
        writer.writerow([iso(time_ns), *rest])
        count += 1
    text.detach()
    return count


def _events_to_parquet(stream: IO[bytes], rows: Iterator[tuple[Any, ...]]) -> int:
    arrow, parquet = library("pyarrow", ANALYSIS), library("pyarrow.parquet", ANALYSIS)
    types = {"time": arrow.timestamp("ns", "UTC"), "number": arrow.uint64()} | dict.fromkeys(
        _EVENT_NUMBERS, arrow.uint64()
    )
    schema = arrow.schema([(name, types.get(name, arrow.string())) for name in _EVENT_COLUMNS])
    count = 0
    with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
        while some := list(islice(rows, _EVENT_BATCH)):
            columns = [
                arrow.array(column, kind.type) for column, kind in zip(zip(*some, strict=True), schema, strict=True)
            ]
            writer.write_table(arrow.table(columns, schema=schema))
            count += len(some)
    return count


class _Row(NamedTuple):
    log_ns: int
    channel: int
    publish_ns: int
    data: bytes


def export_mcap(
    dump: Dump,
    chosen: Chosen,
    stream: IO[bytes],
    from_ns: int,
    to_ns: int,
    *,
    raw: bool,
    progress: Callable[[int], None],
) -> int:
    """Write an MCAP file with a JSON message for each frame and each event.

    The topic of frames is ``/<source>``. The topic of events is ``/<source>/events``.

    Args:
        dump: The recording.
        chosen: The registers to export, by block.
        stream: The new file.
        from_ns: Start of the range, log time in ns.
        to_ns: End of the range, log time in ns.
        raw: True to export the values that the source delivered, without injections; False to export
            the values that readers saw.
        progress: Called with the time in ns, from the start of the recording, up to which it is
            done.

    Returns:
        The number of messages.
    """
    writer = McapWriter(stream, "", f"shmio {__version__}")
    sources = list(dict.fromkeys(block.source for block in chosen))
    streams = [_frames(dump, source, chosen, writer, from_ns, to_ns, raw=raw) for source in sources]
    streams += [_events(dump, source, writer, from_ns, to_ns) for source in sources]
    count = 0
    for row in heapq.merge(*streams, key=lambda row: row.log_ns):
        writer.add_messages(row.channel, [(row.log_ns, row.publish_ns, 0, (row.data,))])
        progress(row.log_ns - dump.begin_ns)
        count += 1
    writer.finish()
    return count


def _frames(
    dump: Dump, source: str, chosen: Chosen, writer: McapWriter, from_ns: int, to_ns: int, *, raw: bool
) -> Iterator[_Row]:
    channels: dict[DumpBlock, int] = {}
    for block, columns in pieces(dump, source, chosen, from_ns, to_ns, raw=raw):
        tree = _tree(columns.registers, source)
        if block not in channels:
            schema = {
                _FRAME: {"type": "object", "properties": {name: {"type": kind} for name, kind in _FRAME_FIELDS.items()}}
            }
            schema |= _schema(tree, columns)
            channels[block] = _channel(writer, f"/{source}", f"{source} {block.layout.name}", schema)
        heads = zip(*(getattr(columns, name).tolist() for name in _FRAME_FIELDS), strict=True)
        values = zip(*(_plain(columns[register.path]) for register in columns.registers), strict=True)
        rows = zip(columns.time_ns.tolist(), columns.source_ns.tolist(), heads, values, strict=True)
        for log_ns, source_ns, head, row in rows:
            message = {_FRAME: dict(zip(_FRAME_FIELDS, head, strict=True))}
            if source_ns:  # otherwise the source had no values yet
                message |= _filled(tree, row)
            yield _Row(log_ns, channels[block], source_ns if source_ns > 0 else log_ns, msgspec.json.encode(message))


def _events(dump: Dump, source: str, writer: McapWriter, from_ns: int, to_ns: int) -> Iterator[_Row]:
    channel = 0
    explainers: dict[DumpBlock, Explainer] = {}
    for log_ns, block, event in dump.events(source, from_ns, to_ns):
        schema = {name: _property(kind) for name, kind in _EVENT_TYPES.items()}
        channel = channel or _channel(writer, f"/{source}/events", "event", schema)
        if block is None:
            continue
        explained = explainers.setdefault(block, Explainer(source, block.layout)).explain(event)
        what = {"kind": kind_of(event), "quality": str(event.quality), "number": event.number}
        about = object_of(event, explained)
        about["laid"] = about["laid"] or {}
        numbers = {"frame": event.frame, "cycle": event.cycle}
        yield _Row(log_ns, channel, log_ns, msgspec.json.encode(what | numbers | about))


def _property(kind: str) -> dict[str, Any]:
    return {"type": kind, "items": {"type": "string"}} if kind == "array" else {"type": kind}


def _channel(writer: McapWriter, topic: str, name: str, properties: dict[str, Any]) -> int:
    text = msgspec.json.encode({"title": name, "type": "object", "properties": properties})
    return writer.register_channel(topic, "json", writer.register_schema(name, "jsonschema", text))


def _tree(registers: Sequence[Register], source: str) -> dict[str, Any]:
    """Return a tree of the registers by path segments. Its leaves are the indices of the registers.

    If a path begins with ``frame``, which is the key of the header fields, the source precedes it.
    """
    tree: dict[str, Any] = {}
    for place, register in enumerate(registers):
        first, *others = register.path.split("/")
        *above, name = heading(source, first, (_FRAME,)), *others
        node = tree
        for segment in above:
            below = node.setdefault(segment, {})
            if not isinstance(below, dict):  # a register and a structure have the same name
                node, name = tree, register.path
                break
            node = below
        node[name if name not in node else register.path] = place
    return tree


def _filled(tree: dict[str, Any], row: Sequence[Any]) -> dict[str, Any]:
    return {name: _filled(below, row) if isinstance(below, dict) else row[below] for name, below in tree.items()}


def _schema(tree: dict[str, Any], columns: Columns) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, below in tree.items():
        if isinstance(below, dict):
            found[name] = {"type": "object", "properties": _schema(below, columns)}
            continue
        values = columns[columns.registers[below].path]
        kind: dict[str, Any] = {"type": _JSON_TYPES.get(values.dtype.kind, "string")}
        for _ in values.shape[1:]:
            kind = {"type": "array", "items": kind}
        found[name] = kind
    return found


def _plain(values: npt.NDArray[Any]) -> list[Any]:
    """Convert values for JSON.

    Durations become numbers, and dates become texts. Invalid and infinite values become null.
    """
    kind = values.dtype.kind
    found: Any = values
    if kind == "f" and not np.isfinite(values).all():
        return [_finite(value) for value in values.tolist()]
    if kind == "V":
        return [_hex(value) for value in values]
    if kind in "mM":
        found = (values.astype(np.int64) if kind == "m" else np.datetime_as_string(values)).astype(object)
        found[np.isnat(values)] = None
    return list(found.tolist())


def _finite(value: Any) -> Any:
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return value if math.isfinite(value) else None


def _hex(value: Any) -> Any:
    return [_hex(item) for item in value] if getattr(value, "ndim", 0) else bytes(value).hex()
