"""The process of an exported instance, as the FMU's library uses it."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from shmio.errors import ValueRangeError
from shmio.lab import Laboratory, prepare_laboratory
from shmio.lab.fmu.process import HELLO, INITIALISE, STEP, Manifest, Session

CONFIG = """
[instance]
name = "fmu-process-test"

[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
period_ms = 20
"""


def test_the_rounding_of_steps_does_not_add_up(tmp_path: Path) -> None:
    """A step of 1/60 s is no whole number of ns. The program that runs the FMU counts in s."""
    (tmp_path / "panel.toml").write_text('[registers]\nspeed = "LREAL"\n')
    file = tmp_path / "supervisor.toml"
    file.write_text(CONFIG)
    with Laboratory(prepare_laboratory(file)) as lab, lab.attach() as cell:
        session = Session(lab, cell, Manifest(file.name, [], ["panel/speed"]))
        values = session.answer(HELLO, struct.pack("=3d", 0, 0, 0))
        session.answer(INITIALISE, struct.pack("=2d", 10, 0) + values)
        for number in range(30):
            session.answer(STEP, struct.pack("=2d", 10 + number / 60, 1 / 60) + values)
        assert abs(cell.clock.time_ns - 500_000_000) <= 1


def test_texts_are_utf_8(tmp_path: Path) -> None:
    (tmp_path / "panel.toml").write_text('[registers]\nname = { type = "WSTRING[9]", initial = "✓" }\n')
    file = tmp_path / "supervisor.toml"
    file.write_text(CONFIG)
    with Laboratory(prepare_laboratory(file)) as lab, lab.attach() as cell:
        session = Session(lab, cell, Manifest(file.name, [], ["panel/name"]))
        text = "✓".encode()
        assert session.answer(HELLO, struct.pack("=2dI", 0, 0, 0)) == struct.pack("=I", len(text)) + text
        with pytest.raises(ValueRangeError, match="text that is not UTF-8"):
            session.answer(INITIALISE, struct.pack("=2dI", 0, 0, 1) + b"\xff")
