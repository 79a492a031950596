"""Export events as a table: CSV or Parquet."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Collection, Iterator
from itertools import islice
from typing import IO, Any, Final

from shmio.recording.dump import Dump
from shmio.recording.libraries import ANALYSIS, library
from shmio.recording.reading.blocks import DumpBlock
from shmio.recording.times import iso
from shmio.segment.explain import Explainer, cells_of, kind_of

NUMBERS: Final = ("frame", "cycle", "injection", "command", "item", "items", "offset", "mask", "size")
COLUMNS: Final = (
    "time", "source", "number", "kind", "quality", "path", "value", "direction", "by", "text", *NUMBERS, "data",
)  # fmt: skip
BATCH: Final = 4096


def export_events(
    dump: Dump,
    sources: Collection[str],
    stream: IO[bytes],
    form: str,
    from_ns: int,
    to_ns: int,
    progress: Callable[[int], None],
) -> int:
    """Write a row for each event of these sources.

    Args:
        dump: The recording.
        sources: Names of sources.
        stream: The new file.
        form: ``csv`` or ``parquet``.
        from_ns: Start of the range.
        to_ns: End of the range.
        progress: Called with the ns of the recording that are done.

    Returns:
        The number of rows.

    Raises:
        MissingLibraryError: pyarrow is not installed.
    """
    rows = _rows(dump, sources, from_ns, to_ns, progress)
    return _parquet(stream, rows) if form == "parquet" else _csv(stream, rows)


def _rows(
    dump: Dump, sources: Collection[str], from_ns: int, to_ns: int, progress: Callable[[int], None]
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows in the order of COLUMNS, with the time in ns."""
    explainers: dict[DumpBlock, Explainer] = {}
    for time_ns, block, event in dump.events(sources, from_ns, to_ns):
        if block is None:
            continue
        if block not in explainers:
            explainers[block] = Explainer(block.source, block.layout)
        about = cells_of(explainers[block].explain(event))
        head = time_ns, block.source, event.number, kind_of(event), str(event.quality)
        yield *head, *about, event.text, *(getattr(event, name) for name in NUMBERS), event.data.hex()
        progress(time_ns - dump.begin_ns)


def _csv(stream: IO[bytes], rows: Iterator[tuple[Any, ...]]) -> int:
    text = io.TextIOWrapper(stream, "utf-8", newline="", write_through=True)
    writer = csv.writer(text)
    writer.writerow(COLUMNS)
    count = 0
    for time_ns, *rest in rows:
        writer.writerow([iso(time_ns), *rest])
        count += 1
    text.detach()
    return count


def _parquet(stream: IO[bytes], rows: Iterator[tuple[Any, ...]]) -> int:
    arrow, parquet = library("pyarrow", ANALYSIS), library("pyarrow.parquet", ANALYSIS)
    types = {"time": arrow.timestamp("ns", "UTC"), "number": arrow.uint64()} | dict.fromkeys(NUMBERS, arrow.uint64())
    schema = arrow.schema([(name, types.get(name, arrow.string())) for name in COLUMNS])
    count = 0
    with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
        while some := list(islice(rows, BATCH)):
            columns = [
                arrow.array(column, kind.type) for column, kind in zip(zip(*some, strict=True), schema, strict=True)
            ]
            writer.write_table(arrow.table(columns, schema=schema))
            count += len(some)
    return count
