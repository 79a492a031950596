"""A whole instance that reads a rosbridge server and another source. The server freezes, dies and comes back."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from shmio.testing.cell import Cell, until
from tests.unit.connectors.ros.bridge import Bridge

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "arm"
connector = "rosbridge"
layout = "arm.toml"
period_ms = 20
url = "URL"
timeout = 500
max_age = 60000
[[source]]
name = "other"
connector = "rosbridge"
layout = "other.toml"
period_ms = 20
url = "OTHER"
"""
ARM = """
[registers]
"arm/j1" = { type = "LREAL", address = "/joint_states sensor_msgs/JointState position[name=j1]", unit = "rad" }
"arm/gone" = { type = "LREAL", address = "/joint_states sensor_msgs/JointState position[name=j9]" }
"arm/speed" = { type = "LREAL", address = "/speed std_msgs/Float64 data", writable = true }
"""
OTHER = """
[registers]
"count" = { type = "ARRAY[1..2] OF LREAL", address = "/count std_msgs/Float64MultiArray data" }
"""
STATE = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}, "velocity": [], "effort": []}


def test_a_bridge_is_read_written_frozen_lost_and_back(make_cell: Callable[..., Cell]) -> None:
    with Bridge() as bridge, Bridge() as other:
        bridge.ask("publish", "/joint_states", STATE | {"name": ["j0", "j1"], "position": [0.0, 1.5]})
        other.ask("count", "/count", 2, 10)
        cell = make_cell(config=CONFIG.replace("URL", bridge.url).replace("OTHER", other.url))
        (cell.folder / "arm.toml").write_text(ARM)
        (cell.folder / "other.toml").write_text(OTHER)
        cell.up()

        def quality(name: str) -> Any:
            return cell.processes()[name]["quality"]

        def counted() -> float:
            found = json.loads(cell.output("shmio", "get", "--json", "other/count"))["other/count"]
            assert found["quality"] == "good"
            return float(found["value"][0])

        until(lambda: quality("arm") == quality("other") == "good", "good quality")
        found = json.loads(cell.output("shmio", "get", "--json", "arm"))
        assert (found["arm/arm/j1"]["value"], found["arm/arm/j1"]["quality"]) == (1.5, "good")
        assert "BadNotFound" in found["arm/arm/gone"]["reason"]
        assert found["arm/arm/speed"]["quality"] == "bad"  # nobody has commanded one
        cell.output("shmio", "set", "arm/arm/speed", "0.25")
        assert bridge.ask("last", "/speed") == {"data": 0.25}
        bridge.freeze()
        until(lambda: quality("arm") == "bad", "bad quality while the bridge is silent")
        before = counted()
        bridge.thaw()
        until(lambda: quality("arm") == "good", "good quality")
        bridge.kill()
        until(lambda: quality("arm") == "bad", "bad quality")
        assert counted() > before
        bridge.start()
        bridge.ask("publish", "/joint_states", STATE | {"name": ["j1"], "position": [2.5]})
        until(lambda: quality("arm") == "good", "good quality")
        until(
            lambda: json.loads(cell.output("shmio", "get", "--json", "arm/arm/j1"))["arm/arm/j1"]["value"] == 2.5,
            "the new value",
        )
        assert {name: cell.processes()[name]["restarts"] for name in ("arm", "other")} == {"arm": 0, "other": 0}
