"""``shmio fabric archive``: writes the histories of cells to Parquet files, until it is stopped."""

from __future__ import annotations

import argparse
import asyncio
import logging
import signal
import sys
from typing import TYPE_CHECKING

from shmio.cli.common import ended_by_interrupt, say, say_json
from shmio.cli.fabric.access import access
from shmio.libraries import ANALYSIS, library
from shmio.wording import printable

if TYPE_CHECKING:
    from shmio.fabric.archive.cell_files import ClosedFile


def execute(options: argparse.Namespace) -> int:
    """Archive until a signal stops the command."""
    place = access(options)
    with ended_by_interrupt():
        library("pyarrow.parquet", ANALYSIS)
        from shmio.fabric.archive.folder import ArchiveFolder  # noqa: PLC0415  it needs the extras
        from shmio.fabric.archive.service import Archive, ArchiveLimits  # noqa: PLC0415

    def closed(file: ClosedFile) -> None:
        if options.json:
            say_json({"file": str(file.path), "rows": file.rows})
        else:
            say(f"{file.path}: {file.rows} rows")

    async def work() -> None:
        stopping = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):  # before others can see that the folder is in use
            asyncio.get_running_loop().add_signal_handler(number, stopping.set)
        folder = ArchiveFolder(options.output)
        try:
            limits = ArchiveLimits(options.close_mb * 1_000_000, options.close_after)
            await Archive(place, folder, options.cells or ["*"], limits, closed, stopping).run()
        finally:
            folder.close()

    console = logging.StreamHandler(sys.stderr)
    console.setFormatter(_Printable("%(asctime)s %(message)s"))
    log = logging.getLogger("shmio.fabric")
    log.addHandler(console)
    log.setLevel(logging.INFO)
    try:
        asyncio.run(work())
    finally:
        log.removeHandler(console)
    return 0


class _Printable(logging.Formatter):
    """Names in messages come from the network."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, without control characters."""
        return printable(super().format(record))
