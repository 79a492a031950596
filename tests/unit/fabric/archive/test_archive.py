"""The archive has each frame of the history once, also after it was killed."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import polars
import pytest

from shmio.cli.user import main
from shmio.fabric.archive.cell_files import ClosedFile
from shmio.fabric.archive.folder import ArchiveFolder
from shmio.fabric.archive.service import Archive, ArchiveLimits
from shmio.fabric.connection import Access
from shmio.fabric.messages import decode_entries, encode
from shmio.fabric.names import CellName
from shmio.segment import Segment
from shmio.testing.cell import until
from tests.nats_server import lose_cancellation
from tests.unit.fabric.stored import CELL, History, Stored, Uplink, late
from tests.unit.recorder.harness import LAYOUT, OTHER, publish, spec

DAY = datetime.now(UTC)


class Running:
    """The command as a process."""

    def __init__(self, history: History, folder: Path, *options: str) -> None:
        self._closed: list[str] = []
        self.process = subprocess.Popen(
            [
                sys.executable, "-c", "import sys; from shmio.cli.user import main; sys.exit(main())",
                "fabric", "archive", "--server", history.url, "-o", str(folder), *options,
            ],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._closed.append(line.strip())

    @property
    def closed(self) -> list[str]:
        """The lines about closed files."""
        return list(self._closed)

    def stop(self, sign: signal.Signals = signal.SIGTERM) -> int:
        self.process.send_signal(sign)
        return self.wait()

    def wait(self) -> int:
        status = self.process.wait(30)
        self._reader.join()
        assert self.process.stderr is not None
        self.errors = self.process.stderr.read()
        self.process.stderr.close()
        assert self.process.stdout is not None
        self.process.stdout.close()
        return status


@contextmanager
def running(history: History, folder: Path, *options: str) -> Iterator[Running]:
    work = Running(history, folder, *options)
    try:
        yield work
    finally:
        if work.process.returncode is None:
            work.stop(signal.SIGKILL)


def rows(folder: Path, source: str = "cell", cell: CellName = CELL) -> list[tuple[Any, ...]]:
    """Return number and value of each row of a source, in the order of time."""
    files = sorted(folder.glob(f"cell={cell}/day=*/{source}-*.parquet"))
    if not files:
        return []
    table = polars.concat([polars.read_parquet(file) for file in files], how="diagonal_relaxed")
    found: list[tuple[Any, ...]] = table.sort("time").select("number", "count").rows()
    return found


def read_to_end(folder: Path, *histories: History) -> Running:
    """Archive all that is there, and stop."""
    for history in histories:
        history.forget(folder)
    with running(histories[0], folder) as work:
        for history in histories:
            last = history.last()
            until(lambda h=history, n=last: h.delivered(folder) >= n, "the archive to receive all")  # type: ignore[misc]
        assert work.stop() == 0, work.errors
    return work


def test_all_frames_of_all_sources_are_written_once(segment: Segment, history: History, tmp_path: Path) -> None:
    """Late messages, duplicates, damaged ones, and a second cell."""
    folder = tmp_path / "archive"
    other = History(history.url, CellName("plant1", "line3", "b-2"))
    history.create()
    other.create()
    uplink = Uplink(segment)
    messages: list[Stored] = []
    for turn in range(8):
        publish(segment.writer("cell"), 40, first=turn * 40)
        publish(segment.writer("press"), 40, first=turn * 40)
        messages += uplink.messages(each=3)
    outage = messages[50:80]
    rest = [one for one in messages if one not in outage]
    history.publish(*rest, messages[0]._replace(data=b"noise"), *map(late, outage), *messages[:20])
    theirs = Uplink(segment, other.cell)
    publish(segment.writer("cell"), 5)
    other.publish(*theirs.messages())
    work = read_to_end(folder, history, other)
    for source in ("cell", "press"):
        assert rows(folder, source) == [(number, number - 1) for number in range(1, 321)]
    assert len(work.closed) == 4  # two cells with two sources each
    assert "noise" not in work.errors
    assert "left out" in work.errors
    (day,) = {path.parent.name for path in folder.glob(f"cell={other.cell}/*/*.parquet")}
    assert day == f"day={datetime.now(UTC):%Y-%m-%d}" or day == f"day={DAY:%Y-%m-%d}"
    assert not list(folder.rglob("*.part"))


def test_a_killed_archive_loses_nothing_and_writes_nothing_twice(
    segment: Segment, history: History, tmp_path: Path
) -> None:
    folder = tmp_path / "archive"
    history.create()
    uplink = Uplink(segment)
    published = 0
    for turn in range(3):
        with running(history, folder, "--close-after", "0.3") as work:
            count = len(work.closed)
            for _ in range(3):
                publish(segment.writer("cell"), 100, first=published)
                published += 100
                history.publish(*uplink.messages())
            until(lambda work=work, count=count: len(work.closed) > count, "the first file")  # type: ignore[misc]
            publish(segment.writer("cell"), 100, first=published)
            published += 100
            history.publish(*uplink.messages())
            if turn % 2:
                until(lambda: any(folder.rglob("*.part")), "an open file")
            work.stop(signal.SIGKILL)
    read_to_end(folder, history)
    assert rows(folder) == [(number, (number - 1) & 0x7FFF) for number in range(1, published + 1)]
    assert not list(folder.rglob("*.part"))


def test_a_changed_layout_begins_another_file(
    segment: Segment, history: History, instance: str, tmp_path: Path
) -> None:
    folder = tmp_path / "archive"
    history.create(LAYOUT, OTHER)
    publish(segment.writer("cell"), 5)
    history.publish(*Uplink(segment).messages())
    with Segment.create(f"{instance}-b", [spec("cell", OTHER)], []) as other:
        publish(other.writer("cell"), 3)
        history.publish(*Uplink(other, stream=2).messages())
        other.unlink()
    read_to_end(folder, history)
    found = sorted(polars.read_parquet_schema(file).keys() & {"count", "speed"} for file in folder.rglob("*.parquet"))
    assert found == [{"count"}, {"count", "speed"}]
    assert len(rows(folder)) == 8


def test_a_row_is_in_the_folder_of_its_day(segment: Segment, history: History, tmp_path: Path) -> None:
    folder = tmp_path / "archive"
    history.create()
    publish(segment.writer("cell"), 4)
    messages = [
        one for one in Uplink(segment).messages() if any(hasattr(item, "raw") for item in decode_entries(one.data))
    ]
    first = next(item for item in decode_entries(messages[0].data))
    midnight_ns = 20_000 * 86_400 * 10**9
    moved = []
    for index, one in enumerate(messages):
        zero_ns = midnight_ns - first.publish_ns + (index - 2) * 10**9  # type: ignore[union-attr]
        header = one.header._replace(zero_ns=zero_ns)
        moved.append(one._replace(data=bytes(encode(header, decode_entries(one.data)))))
    history.publish(*moved)
    read_to_end(folder, history)
    counts = {
        file.parent.name: polars.read_parquet(file).height for file in folder.glob(f"cell={CELL}/*/cell-*.parquet")
    }
    assert counts == {"day=2024-10-03": 2, "day=2024-10-04": 2}


def test_a_stream_that_was_made_anew_is_archived_too(segment: Segment, history: History, tmp_path: Path) -> None:
    folder = tmp_path / "archive"
    history.create()
    publish(segment.writer("cell"), 5)
    uplink = Uplink(segment)
    history.publish(*uplink.messages())
    read_to_end(folder, history)
    history.run(lambda client: client.jetstream().delete_stream(CELL.history))
    history.create()
    publish(segment.writer("cell"), 5, first=5)
    history.publish(*uplink.messages())
    read_to_end(folder, history)
    assert rows(folder) == [(number, number - 1) for number in range(1, 11)]


def test_a_second_archive_in_a_folder_is_refused(
    segment: Segment, history: History, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "archive"
    with running(history, folder) as work:
        until(lambda: (folder / ".archive").exists() and bool((folder / ".archive").read_text()), "the lock")
        assert main(["fabric", "archive", "--server", history.url, "-o", str(folder)]) == 1
        assert "another" in capsys.readouterr().err
        assert work.stop() == 0


def test_a_source_name_cannot_leave_the_folder(segment: Segment, history: History, tmp_path: Path) -> None:
    folder = tmp_path / "archive"
    history.create()
    publish(segment.writer("cell"), 1)
    uplink = Uplink(segment)
    for message in uplink.messages():
        history.publish(message._replace(subject=CELL.live("../../../x")))
    work = read_to_end(folder, history)
    assert "not the name of a source" in work.errors
    assert not list(tmp_path.rglob("*.parquet"))


def test_the_archive_ends_if_a_file_cannot_be_written_although_a_cancellation_is_lost(
    segment: Segment, history: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other cells stop, too."""
    other = CellName("plant1", "line3", "b60")
    waits = lose_cancellation(monkeypatch, f"STREAM.INFO.{other.history}")
    history.create()
    History(history.url, other).create()
    publish(segment.writer("cell"), 5)
    messages = Uplink(segment).messages()

    def fail(_file: ClosedFile) -> None:
        raise OSError("the disk is full")

    async def work() -> None:
        archive = Archive(
            Access((history.url,)), folder, ["*"], ArchiveLimits(max_age_s=0.1), fail, asyncio.Event()
        )  # fmt: skip
        running = asyncio.create_task(archive.run())
        assert await asyncio.to_thread(waits.wait, 30)
        await asyncio.to_thread(history.publish, *messages)
        await asyncio.wait_for(running, 30)

    folder = ArchiveFolder(tmp_path / "archive")
    try:
        with pytest.raises(OSError, match="disk is full"):
            asyncio.run(work())
    finally:
        folder.close()


def test_a_damaged_state_is_named(segment: Segment, history: History, tmp_path: Path) -> None:
    folder = tmp_path / "archive"
    history.create()
    state = folder / f"cell={CELL}" / ".archive.json"
    state.parent.mkdir(parents=True)
    state.write_text("{")
    with running(history, folder) as work:
        assert work.wait() == 1
    assert str(state) in work.errors
    state.unlink()
