"""``shmio-dump export``: converts recordings for other programs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from shmio.cli.common import dumps, say
from shmio.cli.recordings.common import DamageReport, Progress, local_files, time_range
from shmio.errors import PathError, RecordingError
from shmio.recording.dump import Chosen, Dump
from shmio.recording.export import TABLES, BlockTables, export_events, export_mcap, pieces
from shmio.recording.reading.part import DumpBlock
from shmio.recording.rewriting import new_file
from shmio.recording.times import span
from shmio.wording import EMPTY, unknown

FORMATS: Final = (*TABLES, "mcap")
SHEETS: Final = frozenset({"ods", "xls", "xlsx"})
OTHERS: Final = frozenset(
    {"arrow", "db", "duckdb", "feather", "h5", "hdf5", "json", "jsonl", "mat", "mem", "tsv", "txt"}
)
"""File name endings that ``export`` refuses, because it cannot write these formats."""


def export(arguments: argparse.Namespace) -> int:
    """Write a recording as tables, one file for each block, or as a single MCAP file for viewers."""
    report = DamageReport()
    named, form = _form(arguments.output, arguments.format)
    if arguments.events and (not named or form not in TABLES):
        raise RecordingError(
            f"{arguments.output}: --events writes one table; choose a name that ends in .csv or .parquet"
        )
    with (
        local_files(arguments) as files,
        report.open(files) as dump,
        Progress(f"exporting to {arguments.output}") as progress,
    ):
        from_ns, to_ns = time_range(arguments, dump.begin_ns)
        chosen = _chosen(dump, arguments)
        if not chosen:
            raise RecordingError(f"{dump.files[0]}: {EMPTY}")
        sources = list(dict.fromkeys(block.source for block in chosen))
        if arguments.events:
            progress.total = dump.end_ns - dump.begin_ns
            with new_file(arguments.output) as stream:
                count = export_events(dump, sources, stream, form, from_ns, to_ns, progress.at)
            return _print_result(arguments, report, [(arguments.output, count)], "rows")
        if form == "mcap":
            progress.total = dump.end_ns - dump.begin_ns
            with new_file(arguments.output) as stream:
                counts = export_mcap(dump, chosen, stream, from_ns, to_ns, raw=arguments.raw, progress=progress.at)
            return _print_result(arguments, report, [(arguments.output, counts)], "messages")
        progress.total = len(sources) * (dump.end_ns - dump.begin_ns)
        with ExitStack() as stack:
            if named:
                _require_one(arguments.output, [block for block in chosen if _within(block, from_ns, to_ns)])
            tables = BlockTables(stack, arguments.output, form, chosen, named=named)
            for place, source in enumerate(sources):
                for block, columns in pieces(dump, source, chosen, from_ns, to_ns, raw=arguments.raw):
                    tables.write(block, columns)
                    past = int(columns.time_ns[-1]) - dump.begin_ns
                    progress.at(place * (dump.end_ns - dump.begin_ns) + past)
        if not tables.files:
            raise RecordingError(
                f"{dump.files[0]} has no frames in that time; it goes {span(dump.begin_ns, dump.end_ns)}"
            )
    return _print_result(arguments, report, tables.files, "rows")


def _print_result(
    arguments: argparse.Namespace, report: DamageReport, files: Sequence[tuple[Path, int]], what: str
) -> int:
    """Print the new files as lines or JSON; return 1 if the recording was damaged."""
    if arguments.json:
        made = [{"file": str(path), what: count} for path, count in files]
        print(dumps({"files": made, "damage": report.texts}, indent=2))
    else:
        for path, count in files:
            say(f"{path}: {count} {what}")
    return int(report.any)


def _form(output: Path, asked: str | None) -> tuple[bool, str]:
    """Return whether the name is that of a file (True) or a folder (False), and the format.

    Raises:
        RecordingError: The name and the requested format contradict each other.

    """
    suffix = output.suffix.lower().removeprefix(".")
    if suffix in SHEETS | OTHERS and not output.is_dir():
        raise RecordingError(f"{output}: export does not write .{suffix}; {_remedy(output, suffix)}")
    if suffix not in FORMATS or output.is_dir():
        return False, asked or "parquet"
    if asked not in (None, suffix):
        raise RecordingError(f"{output}: the ending of this name contradicts --format {asked}; change one of the two")
    return True, suffix


def _remedy(output: Path, suffix: str) -> str:
    if suffix in SHEETS:
        return f"-o {output.with_suffix('.csv')} writes a file that Excel and LibreOffice can open"
    if suffix == "mem":
        return f"shmio-dump cut FILE… -o {output} writes a part of a recording to a new one"
    formats = ", ".join(f".{form}" for form in FORMATS)
    return f"choose a name that ends in one of {formats}, or a folder and --format"


def _within(block: DumpBlock, from_ns: int, to_ns: int) -> bool:
    return bool(block.frames) and block.first_ns <= to_ns and block.last_ns >= from_ns


def _require_one(output: Path, blocks: Sequence[DumpBlock]) -> None:
    """Check that these blocks fit into one table.

    Raises:
        RecordingError: There are several blocks.

    """
    if len(blocks) > 1:
        names = ", ".join(block.source for block in blocks)
        raise RecordingError(f"{output} can hold only one block, but there are {len(blocks)} ({names}); name a folder")


def _chosen(dump: Dump, arguments: argparse.Namespace) -> Chosen:
    if arguments.only:
        chosen = dump.select(arguments.only)
    else:
        chosen = {block: list(block.layout.registers) for block in dump.blocks}
    for source in arguments.sources or ():
        if source not in dump.sources:
            raise PathError(unknown("source", source, dump.sources))
    return {block: some for block, some in chosen.items() if not arguments.sources or block.source in arguments.sources}
