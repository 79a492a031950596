"""A cell whose history the embedded server keeps: fetched and archived, it is what the cell's recorder has."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import polars
import pytest

from shmio.cli.dump import main
from shmio.config import Address
from shmio.recording.check import check
from shmio.recording.dump import open_dump
from shmio.recording.reading.reader import Reader
from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.ports import reserved_port

FABRIC = """
[recorder]
directory = "dumps"
[fabric]
server = "embedded"
listen = "{nats}"
cell = "plant1.line3.a50"
[fabric.history]
"""


@pytest.fixture
def address() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


def test_history_and_archive_equal_the_recording(
    make_cell: Callable[..., Cell], address: Address, tmp_path: Path
) -> None:
    """The server is killed in between, and the archive, too."""
    cell = make_cell(config=CONFIG + FABRIC.replace("{nats}", str(address)))
    cell.up()
    place, folder, fetched = f"nats://{address}", tmp_path / "archive", tmp_path / "fetched.mem"
    command = [
        sys.executable, "-c", "import sys; from shmio.cli.user import main; sys.exit(main())",
        "fabric", "archive", "--server", place, "-o", str(folder), "--close-after", "1",
    ]  # fmt: skip

    def closed() -> list[Path]:
        return list(folder.glob("cell=plant1.line3.a50/day=*/cell-*.parquet"))

    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as archive:
        until(lambda: bool(closed()), "the first file")
        kill(cell.processes()["nats"]["pid"])
        archive.kill()
    until(lambda: cell.processes()["fabric"]["counters"]["connects"] == 2, "the uplink's reconnection")
    before = len(closed())
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as archive:
        until(lambda: len(closed()) > before + 1, "more files")
        archive.terminate()
        assert archive.wait(30) == 0
    assert main(["fetch", f"{place}/plant1.line3.a50", "-o", str(fetched)]) == 0
    cell.down()
    (recorded,) = (cell.folder / "dumps").glob("*.mem")
    with Reader(fetched) as reader:
        assert check(reader).texts() == []
    with open_dump([fetched]) as far, open_dump([recorded]) as near:
        assert not [gap for gap in far.gaps if gap.what == "frames"]
        mine = {entry.item.number: entry for entry in near.frames("cell")}
        theirs = list(far.frames("cell"))
        assert len(theirs) > 50
        assert [(entry.time_ns, entry.item) for entry in theirs] == [
            (mine[entry.item.number].time_ns, mine[entry.item.number].item) for entry in theirs
        ]
        events = {entry.item.number: entry.item for entry in near.events("cell")}
        assert all(entry.item == events[entry.item.number] for entry in far.events("cell"))
    numbers = sorted(number for file in closed() for number in polars.read_parquet(file)["number"])
    assert numbers == list(range(theirs[0].item.number, theirs[0].item.number + len(numbers)))
