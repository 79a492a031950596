"""A whole instance that reads a node of ROS 2 and another source. The node freezes, dies and comes back."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from shmio.testing.cell import Cell, until
from tests.unit.connectors.ros.dds_peer import Peer

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "arm"
connector = "ros2"
layout = "arm.toml"
period_ms = 20
domain = DOMAIN
timeout = 1000
max_age = 500
[[source]]
name = "other"
connector = "ros2"
layout = "other.toml"
period_ms = 20
domain = DOMAIN
timeout = 1000
"""


def test_a_node_is_read_written_frozen_lost_and_back(make_cell: Callable[..., Cell]) -> None:
    with Peer() as peer, Peer() as other:
        cell = make_cell(config=CONFIG.replace("DOMAIN", str(peer.domain)))
        counted = peer.address("counted", "std_msgs/Float64MultiArray data")
        spare = peer.address("spare", "std_msgs/Int16MultiArray data")
        (cell.folder / "arm.toml").write_text(
            f'[registers]\n"count" = {{ type = "ARRAY[1..2] OF LREAL", address = "{counted}" }}\n'
            f'"spare" = {{ type = "ARRAY[1..2] OF INT", address = "{spare}", writable = true }}\n'
        )
        counted = other.address("counted", "std_msgs/Float64MultiArray data")
        (cell.folder / "other.toml").write_text(
            f'[registers]\n"count" = {{ type = "ARRAY[1..2] OF LREAL", address = "{counted}" }}\n'
        )
        peer.ask("count", 2, 0.01)
        other.ask("count", 2, 0.01)
        cell.up()

        def register(path: str) -> Any:
            return json.loads(cell.output("shmio", "get", "--json", path))[path]

        def becomes(path: str, quality: str) -> None:
            until(lambda: register(path)["quality"] == quality, f"{path} is {quality}")

        becomes("arm/count", "good")
        becomes("other/count", "good")
        cell.output("shmio", "set", "arm/spare", "[3, -4]")
        assert peer.ask("commanded") == [3, -4]
        peer.freeze()
        becomes("arm/count", "bad")
        assert "BadTimeout" in register("arm/count")["reason"]
        before = register("other/count")
        peer.thaw()
        becomes("arm/count", "good")
        peer.kill()
        becomes("arm/count", "bad")
        after = register("other/count")
        assert (before["quality"], after["quality"], after["value"] > before["value"]) == ("good", "good", True)
        peer.start()
        peer.ask("count", 2, 0.01)
        becomes("arm/count", "good")
        assert {name: cell.processes()[name]["restarts"] for name in ("arm", "other")} == {"arm": 0, "other": 0}
