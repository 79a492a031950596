"""Recordings of a source that gives each register a status."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmio.layout.values.codec import codec
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, GOOD, RegisterStatus, StatusArea, status_registers
from shmio.recording.compare import Comparison, compare
from shmio.recording.dump import open_dump
from shmio.recording.selection import RecordedRegisters
from tests.unit.recording.build import build
from tests.unit.statuses import COUNT, LAYOUT, ROW, SOURCE_NS, SPEED, first_image


def recording(file: Path, *bad: int) -> Path:
    """Record three frames. In the second frame, the registers ``bad`` are bad."""
    with build(file) as work:
        work.block("plant", LAYOUT)
        for at in (1, 2, 3):
            image = first_image()
            for index in bad if at == 2 else ():
                image.fail(index, BAD_NODE_ID_UNKNOWN, SOURCE_NS + 50)
            work.frame(at, bytes(image), "plant")
    return file


def test_columns_have_the_statuses_of_the_chosen_registers(tmp_path: Path) -> None:
    with open_dump(recording(tmp_path / "a.mem", SPEED)) as dump:
        columns = dump.columns("plant/speed")
        assert list(columns) == ["speed", "speed#status", "speed#source_ns"]
        assert columns["speed"].tolist() == [1.5] * 3
        assert columns["speed#status"].tolist() == [GOOD, BAD_NODE_ID_UNKNOWN, GOOD]
        assert columns["speed#source_ns"].tolist() == [SOURCE_NS + SPEED, SOURCE_NS + 50, SOURCE_NS + SPEED]
        assert "row#status" in dump.columns("plant/row/2")


def test_recordings_that_differ_in_a_status_are_different(tmp_path: Path) -> None:
    with open_dump(recording(tmp_path / "a.mem", SPEED)) as one, open_dump(recording(tmp_path / "b.mem")) as other:
        (found,) = compare(one, other, Comparison())
        assert list(found.registers) == ["speed#status"]
        (found,) = compare(one, other, Comparison(only=("plant/count",)))
        assert found.same
    with open_dump(recording(tmp_path / "c.mem", COUNT)) as one, open_dump(recording(tmp_path / "d.mem", COUNT)) as two:
        (found,) = compare(one, two, Comparison())
        assert found.same


@pytest.mark.parametrize("kept", [(SPEED,), (COUNT, ROW), (COUNT, SPEED, ROW)])
def test_a_part_of_the_registers_keeps_its_statuses(kept: tuple[int, ...], tmp_path: Path) -> None:
    image = first_image()
    image.fail(SPEED, BAD_NODE_ID_UNKNOWN, SOURCE_NS + 5)
    part = RecordedRegisters(LAYOUT, [LAYOUT.registers[index] for index in kept])
    with open_dump(recording(tmp_path / "a.mem")) as dump:
        frame = next(iter(dump.frames("plant"))).item
    reduced = part.keep(frame._replace(raw=bytes(image), effective=bytes(image))).raw
    assert len(reduced) == part.layout.size < LAYOUT.size
    area = StatusArea(part.layout)
    for place, index in enumerate(kept):
        expected = (BAD_NODE_ID_UNKNOWN, SOURCE_NS + 5) if index == SPEED else (GOOD, SOURCE_NS + index)
        assert area.get(reduced, place) == RegisterStatus(*expected)
        register = LAYOUT.registers[index]
        assert codec(register, "little").decode(reduced) == codec(register, "little").decode(bytes(image))


def test_layouts_without_a_status_area_have_no_registers_of_statuses() -> None:
    from dataclasses import replace

    assert status_registers(replace(LAYOUT, status_offset=None), LAYOUT.registers) == []
    assert [one.path for one in status_registers(LAYOUT, LAYOUT.registers[:1])] == ["count#status", "count#source_ns"]
