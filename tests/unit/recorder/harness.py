"""Helpers for the tests of recordings."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from shmio.layout.model import Layout, Register
from shmio.recorder.file_output import Output, create
from shmio.recorder.instance_follower import FROM_THE_FIRST, InstanceFollower, StartPositions
from shmio.recorder.recorder import Recorder
from shmio.recording.format.encoding import Gap, ProcessChange
from shmio.recording.reading.reader import Message, Reader
from shmio.recording.reading.survey import survey
from shmio.recording.selection import Selection
from shmio.segment import BlockSpec, BlockWriter, Event, Frame, Segment

LAYOUT = Layout("DB1", 1, 2, False, (Register("count", "INT", (), 0, None, 2, 1),))
OTHER = Layout(
    "DB1", 1, 6, False, (Register("speed", "REAL", (), 0, None, 4, 1), Register("count", "INT", (), 4, None, 2, 1))
)
RING = 512


def spec(source: str, layout: Layout = LAYOUT) -> BlockSpec:
    """Return a block with a ring of RING frames."""
    return BlockSpec(source, layout, 20_000_000, 60_000_000_000, 1 << 22)


def publish(writer: BlockWriter, count: int, first: int = 0) -> None:
    """Publish frames whose register and cycle count up."""
    size = writer.block.layout.size
    for cycle in range(first, first + count):
        writer.publish((cycle & 0x7FFF).to_bytes(size, "big"), cycle=cycle)


def recorder(
    segment: Segment,
    folder: Path,
    start: StartPositions = FROM_THE_FIRST,
    selection: Selection | None = None,
    **options: Any,
) -> Recorder:
    """Return a recorder that runs in this process."""
    path, fd = create(folder, segment.instance)
    return Recorder(
        InstanceFollower(segment, start, selection), Output(path, fd, limit_bytes=1 << 24), by="test", **options
    )


def read(file: Path) -> list[Message]:
    """Return all messages except those about processes."""
    return [message for message in everything(file) if not isinstance(message.item, ProcessChange)]


def everything(file: Path) -> list[Message]:
    with Reader(file) as reader:
        return list(reader.messages())


def changes(file: Path) -> list[ProcessChange]:
    """Return the process changes in a file."""
    return [message.item for message in everything(file) if isinstance(message.item, ProcessChange)]


def numbers(file: Path, source: str = "cell", kind: type[Frame] | type[Event] = Frame) -> list[int]:
    """Return the numbers of a source's frames or events, in the order of the file."""
    found = []
    for message in read(file):
        if message.channel.source == source and isinstance(message.item, kind):
            assert not isinstance(message.item, Gap)
            found.append(message.item.number)
    return found


def gaps(file: Path) -> list[Gap]:
    with Reader(file) as reader:
        return survey(reader).gaps


class Process:
    """The recorder as a process, which is killed at the end of the test."""

    def __init__(self, segment: Segment, folder: Path, *, before: str = "", **config: object) -> None:
        """Start the recorder. ``before``: Python code that its interpreter runs first."""
        self.slot = segment.processes.find("recorder")
        self.folder = folder / "dumps"
        self.log = folder / "recorder.log"
        self._file = self.folder
        settings = {"directory": str(self.folder), "config_file": str(folder / "supervisor.toml"), **config}
        description = {
            "instance": segment.instance,
            "epoch": segment.header.epoch,
            "name": "recorder",
            "kind": "recorder",
            "log_file": str(self.log),
            "config": settings,
        }
        self.popen = subprocess.Popen(
            [sys.executable, "-c", f"import runpy\n{before}\nrunpy.run_module('shmio.recorder', run_name='__main__')"],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.popen.stdin is not None
        self.popen.stdin.write(json.dumps(description))
        self.popen.stdin.close()

    @property
    def file(self) -> Path:
        """Path of the recorder's file, from the last report without a problem."""
        report = self.slot.report
        if report.pid == self.popen.pid and report.note.startswith("to "):
            self._file = self.folder / report.note.removeprefix("to ")
        return self._file

    def counts(self, name: str) -> int:
        """Return a counter of the recorder, from its last report."""
        return self.slot.counters[name] if self.slot.report.pid == self.popen.pid else 0

    def stop(self) -> int:
        """Stop the recorder. Return its exit status."""
        self.popen.terminate()
        return self.popen.wait(30)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.popen.kill()
        self.popen.wait()
        assert self.popen.stderr is not None
        self.popen.stderr.close()
