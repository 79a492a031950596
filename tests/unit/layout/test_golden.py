"""Golden files: placement against addresses written in the sources themselves, and DB201 as a whole."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from pathlib import Path

import pytest

from shmio.layout.compiler import Compiled, Source, compile_sources
from shmio.layout.model import Register

GOLDEN = Path(__file__).parents[2] / "golden" / "layout"
RULES = sorted((GOLDEN / "rules").iterdir())


def compile_file(path: Path) -> Compiled:
    return compile_sources([Source(path.name, path.read_bytes())])


def address(register: Register) -> str:
    return str(register.offset) if register.bit is None else f"{register.offset}.{register.bit}"


@pytest.mark.parametrize("path", RULES, ids=lambda path: path.stem)
def test_registers_are_at_the_stated_addresses(path: Path) -> None:
    compiled = compile_file(path)
    (layout,) = compiled.layouts
    found: dict[tuple[str, str], list[str]] = defaultdict(list)
    for register in layout.registers:
        found[register.path.rpartition("/")[2], register.comment].append(address(register))
    assert found, "a rule file without registers proves nothing"
    assert {key: key[1].split() for key in found} == found
    stated = re.search(r"size: (\d+)", path.read_text())
    assert stated is not None
    assert layout.size == int(stated[1])
    assert not compiled.warnings


def test_rule_files_are_all_there() -> None:
    names = ["arrays", "bool", "constants", "controller", "dimensions", "elementary", "instance", "structs"]
    assert [path.stem for path in RULES] == names


def test_db201_as_printed() -> None:
    compiled = compile_file(GOLDEN / "db201-as-printed.db")
    (layout,) = compiled.layouts
    assert layout.describe() == json.loads((GOLDEN / "db201-as-printed.json").read_bytes())
    assert (layout.size, len(layout.registers), layout.optimized) == (2180, 22, True)
    spaced = [warning for warning in compiled.warnings if "no quotes" in warning.message]
    assert [warning.line for warning in spaced] == [7, 11, 12, 13, 14, 15, 29, 30]
    (optimized,) = set(compiled.warnings) - set(spaced)
    assert "Optimized block access" in optimized.message
    assert 'connector = "opcua"' in optimized.message
