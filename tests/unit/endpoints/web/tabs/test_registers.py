from __future__ import annotations

import json
import struct
from typing import Any

import pytest
from websockets.sync.connection import Connection

from shmio.layout.compiler import Source, compile_sources
from shmio.segment import Attributes, BlockSpec, Quality, Segment
from tests.unit.endpoints.harness import LAYOUT, STALE_NS
from tests.unit.endpoints.web.harness import TIMEOUT_S
from tests.unit.endpoints.web.test_page import pages, said

RAW = struct.pack(">ff", 1.5, float("inf")) + bytes(LAYOUT.size - 8)


def values(browser: Connection, path: str) -> list[Any]:
    """Return the next values of a register that a page receives."""
    while True:
        message = json.loads(browser.recv(TIMEOUT_S))
        if message.get("topic") == "registers" and path in message["data"]:
            return list(message["data"][path])


def test_visible_rows_come_with_their_values(segment: Segment) -> None:
    writer = segment.writer("cell")
    writer.publish(RAW, cycle=1, quality=Quality.GOOD)
    with pages(segment, roles=("read", "write")) as server, server.open() as browser:
        found = said(browser, "registers.rows", first=0, count=50, expanded=["cell", "cell/axis"])["result"]
        assert found["total"] == len(found["rows"])
        rows = {row["path"]: row for row in found["rows"]}
        assert rows["cell/axis"]["expandable"]
        assert (rows["cell/axis/position"]["type"], rows["cell/long"]["type"]) == ("REAL", "BYTE[1..600]")
        assert (rows["cell/step"]["writable"], rows["cell/secret"]["writable"]) == (True, False)
        writer.publish(RAW, cycle=2, quality=Quality.UNCERTAIN, reason="a test")
        while (found := values(browser, "cell/axis/position"))[1] != "uncertain":
            pass
        assert found[:4] == ["1.5", "uncertain", "a test", "live"]
        assert 0 <= found[4] < 60


def test_reload_that_moves_a_register_changes_what_the_page_shows(segment: Segment) -> None:
    segment.writer("cell").publish(RAW, cycle=1, quality=Quality.GOOD)
    moved = "STRUCT pad : REAL; axis : STRUCT speed : REAL; position : REAL; END_STRUCT; END_STRUCT;"
    [layout] = compile_sources([Source("moved.db", f"DATA_BLOCK DB9 {moved} BEGIN END_DATA_BLOCK".encode())]).layouts
    shown = {"first": 0, "count": 0, "expanded": ["cell", "cell/axis"], "marked": "cell/axis/position"}
    with pages(segment) as server, server.open() as browser:
        assert said(browser, "registers.rows", **shown)["result"]["marked"]["path"] == "cell/axis/position"
        assert values(browser, "cell/axis/position")[0] == "1.5"
        segment.change(
            add=[BlockSpec("cell", layout, 20_000_000, STALE_NS, 1 << 20, Attributes("test"))], retire=["cell"]
        )
        segment.writer("cell").publish(struct.pack(">fff", 7.0, 8.0, 9.0), cycle=1, quality=Quality.GOOD)
        topics = set()
        while "registers" not in topics:
            message = json.loads(browser.recv(TIMEOUT_S))
            topics.add(message["topic"])
        assert topics == {"layout", "registers"}
        assert message["data"]["cell/axis/position"][0] == "9.0"
        assert said(browser, "registers.rows", **shown | {"expanded": ["cell"]})["result"]["marked"] is None
        assert said(browser, "registers.rows", **shown | {"filter": "speed"})["result"]["marked"] is None
        assert said(browser, "registers.rows", **shown)["result"]["marked"]["type"] == "REAL"


def test_all_sources_are_expanded_at_first(segment: Segment) -> None:
    with pages(segment) as server, server.open() as browser:
        rows = said(browser, "registers.rows", first=0, count=200)["result"]["rows"]
        assert {row["depth"] for row in rows} == {0, 1}


@pytest.mark.parametrize(
    ("call", "given", "error"),
    [
        ("rows", {"first": 0, "count": 201}, "malformed"),
        ("rows", {"first": 0, "count": 1, "filter": "x" * 1_000}, "malformed"),
        ("set", {"path": "cell/nothing", "value": "1"}, "nothing"),
        ("set", {"path": "cell/step", "value": "99999"}, "out of range"),
        ("set", {"path": "cell/secret", "value": "1"}, "not writable"),
        ("override", {"path": "cell/step", "value": "1"}, "needs the role inject"),
        ("lift", {"path": "cell/step"}, "needs the role inject"),
    ],
)
def test_wrong_request_is_answered(segment: Segment, call: str, given: dict[str, Any], error: str) -> None:
    segment.writer("cell").publish(RAW, cycle=1, quality=Quality.GOOD)
    with pages(segment, roles=("read", "write")) as server, server.open() as browser:
        assert error in said(browser, f"registers.{call}", **given)["error"]
