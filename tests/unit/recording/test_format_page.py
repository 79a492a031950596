"""The programs in docs/reference/dump-format.md run as shown."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from shmio.segment import Segment
from tests.unit.recorder.harness import publish, recorder

PAGE = Path(__file__).parents[3] / "docs/reference/dump-format.md"
SNIPPET = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NAME = re.compile(r'"(\w+-\d{8}T\d{6}Z\.mem)"')


LAST = b"\x12\x34"


@pytest.fixture
def content(segment: Segment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """Return the bytes of a recording of 11 frames."""
    monkeypatch.chdir(tmp_path)
    work = recorder(segment, tmp_path / "dumps")
    writer = segment.writer("cell")
    publish(writer, 10)
    writer.publish(LAST, cycle=10, reason="a reason of some length", effective=b"\x56\x78")
    assert work.close()
    return work.output.path.read_bytes()


def images(program: str, content: bytes) -> list[bytes]:
    """Run a program of the page; return the images that it prints."""
    [name] = NAME.findall(program)
    Path(name).write_bytes(content)
    found: list[bytes] = []
    line = re.search(r"^( +)raw = .*\n", program, re.MULTILINE)
    assert line
    shown = program[: line.end()] + f"{line[1]}found.append(raw)\n" + program[line.end() :]
    exec(compile(shown, str(PAGE), "exec"), {"found": found})
    return found


ALL = [cycle.to_bytes(2, "big") for cycle in range(10)] + [LAST]


def test_the_program_that_reads_a_closed_file(content: bytes) -> None:
    program, _ = SNIPPET.findall(PAGE.read_text())
    assert images(program, content) == ALL


def test_the_program_that_reads_a_file_that_was_not_closed(content: bytes) -> None:
    _, program = SNIPPET.findall(PAGE.read_text())
    assert images(program, content) == ALL
    end = content.rindex(b"cell/frames")
    for size in range(end - 2000, end, 13):
        assert images(program, content[:size]) in (ALL, [])
