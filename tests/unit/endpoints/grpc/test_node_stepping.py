"""Time control of both generations with a client on Node's gRPC stack."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint
from tests.unit.endpoints.stepped import Model, simulate

HERE = Path(__file__).parents[1] / "node"
PROTO = Path(__file__).parents[4] / "proto"
STEPS = 60


async def run(port: int) -> dict[str, Any]:
    process = await asyncio.create_subprocess_exec(
        "node", HERE / "stepping.js", f"127.0.0.1:{port}", PROTO, str(STEPS), stdout=asyncio.subprocess.PIPE
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
def test_a_client_in_node_controls_time(instance: str) -> None:
    assert (HERE / "node_modules").exists(), f"packages for Node are not installed: run npm ci --prefix {HERE}"

    async def test(served: Endpoint, models: dict[str, Model]) -> None:
        found = await run(served.port)
        assert found["setStepSize"] == {}
        assert found["codes"] == [0] * STEPS
        assert found["goal"] == found["expected"], "a step applies the values published before it"
        assert found["clock"] == [["timeStamp", 20_000_000 * number] for number in range(STEPS + 1)]
        begun_ms = 20 * STEPS
        assert found["stream"] == [
            ["SIM://count/out", STEPS],
            *([path, STEPS + n] for n in (1, 2, 3) for path in ("SIM://count/out", "SIMLOG://step")),
        ]
        rest = {"alive": True, "playing": False, "exitCode": 0}
        assert found["answers"] == [
            {"clock": begun_ms + clock, "deltaTime": delta, **rest} for clock, delta in ((50, 50), (70, 20), (120, 50))
        ]
        assert (found["started"]["playing"], found["busy"]) == (True, "FAILED_PRECONDITION")
        assert (found["paused"]["playing"], found["paused"]["alive"]) == (False, True)
        assert (found["stopped"]["playing"], found["stopped"]["alive"]) == (False, False)
        assert found["steps"] == [[0, 0], [1, 20], *([1 + n, 20 + n] for n in range(1, 51))]
        assert found["stepsEnd"] == "OK"
        assert found["statuses"] == [[50, True, False], [20, True, False], [50, True, False], [2, True, True]]

    simulate(instance, test)
