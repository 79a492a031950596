from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from shmio.segment import Segment
from tests.unit.endpoints.web.test_page import pages, said


def line(second: int, process: str, text: str, level: str = "INFO") -> str:
    return f"2026-11-21T05:20:{second:02}.000000Z {level:<7} {process}[12] {text}\n"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    (tmp_path / "supervisor.log").write_text(line(1, "supervisor", "supervising") + line(5, "supervisor", "<b>x</b>"))
    (tmp_path / "cell.log").write_text(line(3, "cell", "connected", "WARNING") + "    Traceback\n")
    (tmp_path / "other.log").write_text(line(2, "other", "of no process"))
    return tmp_path


@pytest.mark.parametrize(
    ("given", "texts"),
    [
        ({}, ["supervising", "connected", "    Traceback", "<b>x</b>"]),
        ({"filter": "SUPER"}, ["supervising", "<b>x</b>"]),
        ({"process": "cell"}, ["connected", "    Traceback"]),
        ({"process": "../cell"}, []),
        ({"process": "other"}, []),
        ({"count": 1}, ["<b>x</b>"]),
    ],
)
def test_lines_of_all_processes(segment: Segment, logs: Path, given: dict[str, Any], texts: list[str]) -> None:
    with pages(segment, folders={"logs": str(logs)}) as server, server.open() as browser:
        assert [one["text"] for one in said(browser, "log.lines", **given)["result"]] == texts


@pytest.mark.parametrize("given", [{"filter": "x" * 201}, {"count": 501}, {"count": 0}])
def test_wrong_request_is_answered(segment: Segment, logs: Path, given: dict[str, Any]) -> None:
    with pages(segment, folders={"logs": str(logs)}) as server, server.open() as browser:
        assert "malformed" in said(browser, "log.lines", **given)["error"]
