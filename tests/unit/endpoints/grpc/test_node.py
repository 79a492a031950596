"""Both versions with clients on Node's gRPC stack, which shares no code with Python's."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

from shmio.segment import Segment
from tests.unit.endpoints.grpc.services.test_publish import counted, with_plant
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint
from tests.unit.endpoints.plant import Plant
from tests.unit.endpoints.rude import CALLS, Polite, beside_a_polite_client

HERE = Path(__file__).parents[1] / "node"
PROTO = Path(__file__).parents[4] / "proto"

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")


@pytest.fixture(autouse=True)
def packages() -> None:
    assert (HERE / "node_modules").exists(), f"packages for Node are not installed: run npm ci --prefix {HERE}"


async def started(script: str, port: int, *arguments: str | Path) -> asyncio.subprocess.Process:
    pipe = asyncio.subprocess.PIPE
    return await asyncio.create_subprocess_exec(
        "node", HERE / script, f"127.0.0.1:{port}", *arguments, stdin=pipe, stdout=pipe
    )


async def run(script: str, port: int, *arguments: str | Path, given: bytes = b"") -> Any:
    process = await started(script, port, *arguments)
    try:
        out, _ = await asyncio.wait_for(process.communicate(given), TIMEOUT_S)
    except TimeoutError:
        process.kill()
        await process.communicate()
        raise
    assert process.returncode == 0
    return json.loads(out)


def test_a_typical_session_of_version_2(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        before_s = served.segment.clock_ns(0) / 1e9
        found = await run("client.js", served.port, PROTO / "simlog_v2.proto")
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
        assert found["given"]["value"] == 20
        assert found["original"] == "NUMBER"
        assert found["shadow"] == [["NUMBER", "IN"], ["NUMBER", "OUT"]]
        assert found["replaced"] == "ABORTED"
        assert found["again"]["value"] == 20
        assert counted(served)[1] == 3  # one of them was published

    with_plant(segment, test)


def test_a_typical_session_of_version_1(segment: Segment) -> None:
    async def test(served: Endpoint, device: Plant) -> None:
        found = await run("client_v1.js", served.port, PROTO / "simlog_v1.proto")
        assert found["topic"] == {"path": "axis/position/in", "msgType": "double"}
        assert (found["unknown"], found["nothing"]) == ("NOT_FOUND", "NOT_FOUND")
        for name in ("input", "output"):
            assert (found[name]["type"], found[name]["value"]) == ("double", "0.0001")
            assert 0 < int(found[name]["nsec"]) <= served.segment.clock_ns(time.monotonic_ns())
        assert found["negative"]["value"] == "-0.0"
        assert found["published"] == {}
        assert found["ended"] == ["CANCELLED", "CANCELLED"]
        assert (found["original"]["value"], found["injected"]["value"]) == ("2.5", "3.5")
        assert (found["taken"], found["lifted"]) == ("ALREADY_EXISTS", "CANCELLED")
        published, refused = counted(served)
        assert published >= 5, "the last value before the injection was lifted"
        assert refused == 2

    with_plant(segment, test)


def given(calls: Any) -> bytes:
    return json.dumps(
        [{"method": c.method, "many": c.many, "request": base64.b64encode(c.request).decode()} for c in calls]
    ).encode()


@pytest.mark.parametrize(
    ("act", "unary", "stream", "publish"),
    [
        ("cancel", "CANCELLED", "CANCELLED", "CANCELLED"),
        ("later", ("CANCELLED", "OK"), ("CANCELLED", "OK"), ("CANCELLED", "OK")),
        ("close", "INVALID_ARGUMENT", "INVALID_ARGUMENT", "OK"),
        ("deadline", "DEADLINE_EXCEEDED", "DEADLINE_EXCEEDED", "DEADLINE_EXCEEDED"),
        ("garbage", "INVALID_ARGUMENT", "INVALID_ARGUMENT", ("OK", "INVALID_ARGUMENT")),
        ("oversize", "RESOURCE_EXHAUSTED", "RESOURCE_EXHAUSTED", "RESOURCE_EXHAUSTED"),
    ],
)
def test_misbehaving_clients_leave_nothing_behind(
    segment: Segment, act: str, unary: Any, stream: Any, publish: Any
) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        for call, told in zip(CALLS, await run("rude.js", served.port, act, given=given(CALLS)), strict=True):
            expected = publish if call.many and not call.first else stream if call.stays else unary
            allowed = expected if isinstance(expected, tuple) else (expected,)
            assert told in [call.ends.name if name == "OK" else name for name in allowed], call.method
            await polite.goes_on()

    beside_a_polite_client(segment, test)


def test_a_client_killed_with_all_calls_open_leaves_nothing_behind(segment: Segment) -> None:
    async def test(served: Endpoint, polite: Polite) -> None:
        process = await started("rude.js", served.port, "hold")
        assert process.stdin is not None
        assert process.stdout is not None
        calls = [call for call in CALLS if not call.method.endswith("LiftAll")]  # LiftAll would end the others
        process.stdin.write(given(calls))
        process.stdin.write_eof()
        try:
            async with asyncio.timeout(TIMEOUT_S):
                assert await process.stdout.readline() == b"holding\n"
                stays = sum(call.stays for call in calls)

                async def held() -> bool:
                    await asyncio.sleep(0)
                    return len(served.server.calls) == 2 + stays

                await served.until(held)
        finally:
            process.kill()
            await process.wait()

    beside_a_polite_client(segment, test)
