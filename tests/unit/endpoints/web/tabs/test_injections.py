from __future__ import annotations

import json
import struct
from typing import Any

import pytest
from websockets.sync.connection import Connection

from shmio.segment import Quality, Segment
from tests.unit.endpoints.harness import LAYOUT
from tests.unit.endpoints.web.harness import TIMEOUT_S
from tests.unit.endpoints.web.test_page import pages, said

CAMPAIGN = """
[[injection]]
name = "drift"
target = "cell/axis/position"
operation = "offset"
value = 2.0
when = "cell/step > 3"
"""


def pushed(browser: Connection, topic: str) -> Any:
    """Return the next data of a topic."""
    while True:
        message = json.loads(browser.recv(TIMEOUT_S))
        if message.get("topic") == topic:
            return message["data"]


def test_check_says_what_a_campaign_would_inject(segment: Segment) -> None:
    with pages(segment) as server, server.open() as browser:
        (found,) = said(browser, "injections.check", text=CAMPAIGN)["result"]
        assert found == {
            "name": "drift",
            "operation": "offset",
            "when": "cell/step > 3",
            "registers": ["cell/axis/position"],
            "count": 1,
        }


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("[[injection]", "campaign: the file is not valid TOML"),
        ("", "injection: this key is needed"),
        (CAMPAIGN.replace("position", "nothing"), "injection[0].target"),
        (CAMPAIGN.replace("> 3", ">"), "injection[0].when"),
        ("x = " + "[" * 5000, "nested more than 64 deep"),
        ("a." * 29_000 + "a = 1", "campaign:1: a key is longer than"),
        ("x = " + "1" * 5000, "too many digits"),
        ("#" * 61_000, "malformed"),
    ],
)
def test_wrong_campaign_is_answered(segment: Segment, text: str, error: str) -> None:
    with pages(segment) as server, server.open() as browser:
        assert error in said(browser, "injections.check", text=text)["error"]


@pytest.mark.parametrize(
    ("when", "holds", "values"),
    [
        ("cell/step > 3", True, [["cell/step", "5"]]),
        (
            "cell/axis/position > 3 or not cell/running",
            True,
            [["cell/axis/position", "0.0"], ["cell/running", "false"]],
        ),
        ("cell/step < 3", False, [["cell/step", "5"]]),
    ],
)
def test_condition_is_evaluated_with_present_values(
    segment: Segment, when: str, holds: bool, values: list[list[str]]
) -> None:
    image = bytearray(LAYOUT.size)
    image[12:14] = struct.pack(">h", 5)
    with pages(segment) as server, server.open() as browser:
        unknown = {"holds": None, "values": [[path, None] for path, _ in values]}
        assert said(browser, "injections.condition", when=when)["result"] == unknown
        segment.writer("cell").publish(bytes(image), cycle=1, quality=Quality.GOOD)
        assert said(browser, "injections.condition", when=when)["result"] == {"holds": holds, "values": values}
        assert "at character" in said(browser, "injections.condition", when=f"{when} >")["error"]


@pytest.mark.parametrize("name", ["start", "lift", "lift_all"])
def test_changes_need_the_role_inject(segment: Segment, name: str) -> None:
    with pages(segment, roles=("read", "write")) as server, server.open() as browser:
        assert "needs the role inject" in said(browser, f"injections.{name}")["error"]


def test_events_come_until_the_tab_is_left(segment: Segment) -> None:
    writer = segment.writer("cell")
    writer.publish(bytes(LAYOUT.size), cycle=1, quality=Quality.GOOD)
    with pages(segment) as server, server.open() as browser:
        said(browser, "injections.follow")
        assert pushed(browser, "injections") == []
        segment.writer("cell").publish(bytes(LAYOUT.size), cycle=2, quality=Quality.GOOD)
        assert said(browser, "injections.leave")["result"] is None
