"""Version 2 as a client on another gRPC stack sees it: that of Node, which shares no line with Python's."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from shmio.segment import Segment
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint
from tests.unit.endpoints.plant import Plant
from tests.unit.endpoints.test_publish import counted, with_plant

HERE = Path(__file__).parent / "node"
PROTO = Path(__file__).parents[3] / "proto" / "simlog_v2.proto"


async def run(port: int) -> dict[str, Any]:
    process = await asyncio.create_subprocess_exec(
        "node", HERE / "client.js", f"127.0.0.1:{port}", PROTO, stdout=asyncio.subprocess.PIPE
    )
    try:
        out, _ = await asyncio.wait_for(process.communicate(), TIMEOUT_S)
    except TimeoutError:
        process.kill()
        await process.communicate()
        raise
    assert process.returncode == 0
    found: dict[str, Any] = json.loads(out)
    return found


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")
def test_a_client_of_node_calls_as_clients_do(segment: Segment) -> None:
    assert (HERE / "node_modules").exists(), f"its packages are not installed: npm ci --prefix {HERE}"

    async def test(served: Endpoint, device: Plant) -> None:
        before_s = served.segment.clock_ns(0) / 1e9
        found = await run(served.port)
        written = found["written"]
        assert (written["path"], written["type"], written["seconds"] > before_s) == ("CELL://step/out", "NUMBER", True)
        assert (found["echo"]["type"], found["list"]["type"], found["structure"]["type"]) == (
            "NUMBER",
            "LIST",
            "STRUCT",
        )
        assert (found["text"]["type"], found["bit"]["type"]) == ("STRING", "BOOL")
        assert found["first"] == {}
        assert found["publish"] == "OK"
        info = {"path": "CELL://step", "type": "NUMBER", "direction": "INOUT", "exists": True}
        assert found["info"] == info
        assert found["unknown"]["exists"] is False
        assert found["read"] == [["CELL://step", "NUMBER", 8], ["cell/axis", "STRUCT", {"position": 0, "speed": 0.5}]]
        assert found["step"] == {}
        assert found["refused"] == "INVALID_ARGUMENT"
        assert found["secret"] == "FAILED_PRECONDITION"
        assert found["inject"] == "UNIMPLEMENTED"
        assert found["replaced"] == "ABORTED"
        assert found["again"]["value"] == 8
        assert counted(served)[1] == 3  # of which one was published

    with_plant(segment, test)
