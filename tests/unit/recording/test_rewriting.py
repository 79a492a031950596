"""New recordings made by a program; tests/unit/cli/test_dump_rewriting.py tests the commands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import shmio
from shmio.errors import PathError, RecordingError
from shmio.recording.check import check
from shmio.recording.reading.part import Entry
from shmio.recording.reading.reader import Item, Reader
from shmio.recording.rewriting import part, rewrite
from tests.unit.recording.build import PERIOD_NS, START_NS, varied


def test_a_program_copies_chosen_registers_and_times_with_progress(tmp_path: Path) -> None:
    done: list[int] = []
    new = tmp_path / "part.mem"
    low, high = START_NS + 16 * PERIOD_NS, START_NS + 40 * PERIOD_NS
    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        entries = part(dump, low, high, registers=["cell/count"])
        made = rewrite(dump, new, "a test", entries, whole=False, progress=done.append)
        wanted = [int(value) for value in dump.columns("cell/count", low, high)["count"]]
        length_ns = dump.end_ns - dump.begin_ns
    with Reader(new) as reader:
        assert check(reader).whole
    with shmio.open_dump(new) as dump:
        assert dump.about["made_by"] == "a test"
        assert [register.path for block in dump.blocks for register in block.layout.registers] == ["count"]
        assert [int(value) for value in dump.columns("cell/count")["count"]] == wanted
    assert made.counts["frames"] == len(wanted) > 0
    assert done == sorted(done)
    assert 0 < done[-1] <= length_ns


def test_a_copy_that_fails_leaves_no_file(tmp_path: Path) -> None:
    new = tmp_path / "new.mem"

    def broken(entries: Iterator[Entry[Item]]) -> Iterator[Entry[Item]]:
        yield next(entries)
        raise RecordingError("broken")

    with shmio.open_dump(varied(tmp_path / "a.mem")) as dump:
        with pytest.raises(RecordingError, match="broken"):
            rewrite(dump, new, "a test", broken(dump.items()))
        assert not new.exists()
        with pytest.raises(PathError):
            part(dump, registers=["cell/none"])
        new.touch()
        with pytest.raises(RecordingError, match="exists already"):
            rewrite(dump, new, "a test", dump.items())
        assert new.exists()
