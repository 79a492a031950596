from __future__ import annotations

import json
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
        ("[[injection]", "this is no TOML"),
        ("", "injection: this key is needed"),
        (CAMPAIGN.replace("position", "nothing"), "injection[0].target"),
        (CAMPAIGN.replace("> 3", ">"), "injection[0].when"),
        ("x = " + "[" * 5000, "this is no TOML"),
        ("#" * 61_000, "malformed"),
    ],
)
def test_wrong_campaign_is_answered(segment: Segment, text: str, error: str) -> None:
    with pages(segment) as server, server.open() as browser:
        assert error in said(browser, "injections.check", text=text)["error"]


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
