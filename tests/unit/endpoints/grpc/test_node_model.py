"""A model in JavaScript computes a source, on Node's own gRPC stack."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path

import pytest

from shmio.client import connect_aio
from shmio.errors import CommandError
from shmio.segment import Quality
from tests.unit.connectors.models.test_stepped import Running
from tests.unit.endpoints.grpc.shmio_v1.remote import serve_remote, shown
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint

HERE = Path(__file__).parents[1] / "node"
PROTO = Path(__file__).parents[4] / "proto/shmio_v1.proto"


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")
def test_a_model_in_node_computes_a_source(instance: str) -> None:
    assert (HERE / "node_modules").exists(), f"packages for Node are not installed: run npm ci --prefix {HERE}"

    async def test(served: Endpoint, drive: Running) -> None:
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            "node", HERE / "model.js", f"127.0.0.1:{served.port}", PROTO, "drive", stdin=pipe, stdout=pipe, stderr=pipe
        )
        try:
            assert process.stderr is not None
            assert await asyncio.wait_for(process.stderr.readline(), TIMEOUT_S) == b"joined\n"
            await shown(drive, Quality.GOOD)
            async with connect_aio(f"127.0.0.1:{served.port}") as cell:
                await cell.step(0.02)
                found = await cell.read("drive")
                assert (found["drive/axis/position"], found["drive/axis/count"]) == (3.0, 1)
                await cell.write({"drive/target": -1.0}, until_accepted=True)
                with pytest.raises(CommandError, match=r"model 'model\.js': the target is behind us"):
                    await cell.step(0.02)
                await cell.write({"drive/target": 4.0}, until_accepted=True)
                await cell.step(0.02)
                found = await cell.read("drive")
                assert (found["drive/axis/position"], found["drive/axis/count"]) == (8.0, 3)
            out, _ = await asyncio.wait_for(process.communicate(b""), TIMEOUT_S)
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        told = json.loads(out)
        assert told["status"] == "OK"
        assert told["joined"]["inputs"] == 5
        assert told["steps"] == [[1, 20_000_000, 1.5], [2, 40_000_000, -1], [3, 60_000_000, 4]]
        await shown(drive, Quality.BAD)

    serve_remote(instance, test)
