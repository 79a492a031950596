from __future__ import annotations

import json
from typing import Any

from shmio.segment import Quality, Segment
from tests.unit.endpoints.web.tabs.test_plots import POSITION, image
from tests.unit.endpoints.web.test_page import pages, said

SCENE: dict[str, Any] = {"bodies": [], "floor": None, "camera": None}


def test_tab_is_absent_without_a_scene(segment: Segment) -> None:
    with pages(segment) as server, server.open() as browser:
        assert "scene" not in json.loads(server.request("GET", "/session")[2])["tabs"]
        assert "unknown call" in said(browser, "scene.get")["error"]


def test_page_gets_the_scene_and_follows_its_registers(segment: Segment) -> None:
    writer = segment.writer("cell")
    writer.publish(image(2.5), cycle=1, quality=Quality.GOOD)
    with pages(segment, scene=SCENE) as server, server.open() as browser:
        assert "scene" in json.loads(server.request("GET", "/session")[2])["tabs"]
        assert said(browser, "scene.get")["result"] == SCENE
        assert "no such register" in said(browser, "registers.follow", paths=["cell/x"])["error"]
        assert said(browser, "registers.follow", paths=[POSITION])["result"] is None
        message = json.loads(browser.recv(10))
        assert message["topic"] == "registers"
        assert message["data"][POSITION][:2] == ["2.5", "good"]
        writer.publish(image(2.5), cycle=2, quality=Quality.BAD, reason="unplugged")
        while message["data"][POSITION][1] != "bad":
            message = json.loads(browser.recv(10))
        assert message["data"][POSITION][2] == "unplugged"
