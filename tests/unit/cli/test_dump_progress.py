"""Progress of long work, on a terminal and elsewhere."""

from __future__ import annotations

import io
import sys
import time
from pathlib import Path

import pytest

from shmio.cli.dump import main
from shmio.cli.recordings import common
from tests.unit.recording.build import plain


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_shown_on_a_terminal_and_erased(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, now_s = Terminal(), [0.0]
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    with common.Progress("reading a\x1bb") as work:
        work.total = 200
        work.at(10)
        assert terminal.getvalue() == "", "short work shows no progress"
        for now_s[0], done in ((1.5, 50), (1.6, 60), (2.0, 150), (3.0, 500)):
            work.at(done)
    shown = terminal.getvalue().split("\r")
    assert [text.removesuffix("\x1b[K").split()[-1] for text in shown[1:-1]] == ["25%", "75%", "100%"]
    assert "a\x1bb" not in terminal.getvalue()
    assert shown[-1] == "\x1b[K"


def test_no_progress_is_written_to_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    monkeypatch.setattr(common, "FIRST_S", -1.0)
    with common.Progress("reading") as work:
        work.total = 2
        work.at(1)
    assert file.getvalue() == ""


@pytest.mark.parametrize("to_a_terminal", [False, True])
def test_progress_is_shown_only_if_the_output_goes_to_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to_a_terminal: bool
) -> None:
    file = plain(tmp_path / "a.mem", 1, 50)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys, "stdout", Terminal() if to_a_terminal else io.StringIO())
    monkeypatch.setattr(common, "FIRST_S", -1.0)
    assert main(["cat", str(file)]) == 0
    assert ("reading" in terminal.getvalue()) != to_a_terminal
