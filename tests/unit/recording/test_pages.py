"""The programs for recordings in the manual run as shown."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest

from shmio.layout.compiler import Source, compile_sources
from tests.unit.recording.build import build

ROOT = Path(__file__).parents[3]
SNIPPET = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NAME = "a50-20261121T083005Z.mem"


def snippets() -> list[tuple[str, str]]:
    pages = ["docs/how-to/analyse-a-recording.md", "docs/reference/python-api.md"]
    return [
        (page, program)
        for page in pages
        for program in SNIPPET.findall((ROOT / page).read_text())
        if f'open_dump("{NAME}")' in program
    ]


def test_the_programs_are_found() -> None:
    assert [page for page, _ in snippets()] == ["docs/how-to/analyse-a-recording.md"] * 3 + [
        "docs/reference/python-api.md"
    ]


@pytest.mark.parametrize(("page", "program"), snippets(), ids=["change", "columns", "pandas", "all"])
def test_a_program_of_the_manual(page: str, program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    source = ROOT / "shmio/cli/a50/db201.db"
    [layout] = compile_sources([Source(source.name, source.read_bytes())]).layouts
    axis = layout.registers[layout.by_path["Robot_800/Axs1_Pos"]]
    with build(tmp_path / NAME) as work:
        work.block("cell", layout)
        for number in range(1, 6):
            image = bytearray(layout.size)
            struct.pack_into(">f", image, axis.offset, number // 2)
            work.frame(number, bytes(image))
    exec(compile(program, page, "exec"), {})
