from __future__ import annotations

import pytest

from shmio.segment import Segment
from tests.unit.endpoints.web.test_page import pages, said


def test_time_is_taken_over_stepped_and_released(segment: Segment) -> None:
    with pages(segment, roles=("read", "control")) as server, server.open() as browser:
        state = said(browser, "time.state")["result"]
        assert (state["clock"]["mode"], state["real_sources"]) == ("wall", ["cell"])
        found = said(browser, "time.step", count=3, dt_s=0.5)["result"]
        assert (found["mode"], found["step"], found["playing"]) == ("virtual", 3, False)
        assert found["time_s"] == pytest.approx(state["clock"]["time_s"], abs=60)
        assert said(browser, "time.release")["result"]["mode"] == "wall"


@pytest.mark.parametrize(
    ("call", "given", "error"),
    [
        ("step", {"count": 0}, "malformed"),
        ("step", {"dt_s": 0}, "malformed"),
        ("play", {"rate": 0}, "malformed"),
        ("play", {"rate": "fast"}, "malformed"),
    ],
)
def test_wrong_request_is_answered(segment: Segment, call: str, given: dict[str, object], error: str) -> None:
    with pages(segment, roles=("read", "control")) as server, server.open() as browser:
        assert error in said(browser, f"time.{call}", **given)["error"]


@pytest.mark.parametrize("name", ["step", "play", "pause", "release"])
def test_control_needs_its_role(segment: Segment, name: str) -> None:
    with pages(segment, roles=("read", "write", "inject")) as server, server.open() as browser:
        assert "needs the role control" in said(browser, f"time.{name}")["error"]
