"""Both clients against a real endpoint."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
import trustme

from shmio.client import Column, Quality, connect, connect_aio
from shmio.config import Address
from shmio.errors import EndpointError, LostError, PathError, QualityError, RemoteError, ValueRangeError
from shmio.segment import Quality as FrameQuality
from shmio.segment import Segment
from shmio.testing.proxy import FaultProxy
from tests.unit.client.both import BOTH, Connect
from tests.unit.endpoints.conftest import segment as segment  # noqa: PLC0414  the fixture
from tests.unit.endpoints.grpc.shmio_v1.test_subscribe import OTHER, reload
from tests.unit.endpoints.harness import LAYOUT, Endpoint, image, serve


def with_client(segment: Segment, connects: Connect, test: Callable[[Endpoint, Any], Awaitable[None]]) -> None:
    """Run a test of a client against an endpoint."""

    async def run(served: Endpoint) -> None:
        async with connects(f"127.0.0.1:{served.port}") as cell:
            await test(served, cell)

    serve(segment, run)


@BOTH
def test_values_by_path(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        served.publish(image(1.5, 2.5, True, b"\1\2", -7))
        assert await cell["cell/axis/position"] == np.float32(1.5)
        found = await cell.read("cell")
        assert found["cell/step"] == found["step"] == -7
        assert found["cell/running"]
        np.testing.assert_array_equal(found["cell/inputs"], np.array([1, 2], np.int32))
        assert found["cell/long"].shape == (600,)
        assert set(found) == {f"cell/{register.path}" for register in LAYOUT.registers}
        assert found.of("cell/step").age_ns > 0
        with pytest.raises(PathError):
            _ = found["cell/nothing"]
        with pytest.raises(
            PathError,
            match=r"^cell/axis/positon: this path is not among .* cell that .*; did you mean 'cell/axis/position'",
        ):
            _ = found["cell/axis/positon"]
        with pytest.raises(PathError):
            _ = found["x/nothing"]

    with_client(segment, connects, test)


@BOTH
def test_reading_has_the_type_of_the_reloaded_register(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        served.publish(image(1.5))
        (one,) = await cell.get("cell/axis/position")
        assert (one.value, one.register.type, one.register.size) == (1.5, "REAL", 4)
        reload(served, OTHER)
        (one,) = await cell.get("cell/axis/position")
        assert (one.register.type, one.register.size) == ("DINT", 4)

    with_client(segment, connects, test)


@BOTH
def test_step_of_count_zero_is_refused(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        with pytest.raises(ValueRangeError, match="at least 1, not 0"):
            await asyncio.wait_for(cell.step(count=0), 20)

    with_client(segment, connects, test)


@BOTH
def test_bad_value_is_never_returned_as_good(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        with pytest.raises(QualityError, match="cell/step: no data yet"):
            await cell["cell/step"]
        wrong = bytearray(image(step=3))
        wrong[17] = 200  # the length of a STRING[8]
        served.writer.publish(wrong, cycle=1)
        assert await cell["cell/step"] == 3
        with pytest.raises(QualityError, match=r"cell/name: the bytes are not a valid STRING\[8\]"):
            await cell["cell/name"]
        assert (await cell.read("cell/name")).of("cell/name")["cell/name"] is None
        served.writer.publish(image(step=4), cycle=2, quality=FrameQuality.BAD, reason="cable out")
        with pytest.raises(QualityError, match="cell/step: cable out"):
            await cell["cell/step"]
        update = (await cell.read("cell/step")).of("cell/step")
        assert (update["cell/step"], update.quality, str(update.quality)) == (4, Quality.BAD, "bad")

    with_client(segment, connects, test)


@BOTH
def test_subscription_yields_changes_as_arrays(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        served.publish(image(1.0, 2.0))
        async with cell.subscribe("cell/axis", "cell/inputs", every_frame=True) as stream:
            update = await anext(stream)
            assert update.whole
            assert update.changed == ["cell/axis/position", "cell/axis/speed", "cell/inputs"]
            served.publish(image(1.0, 3.0, inputs=b"\0\5"))
            served.publish(image(1.0, 3.0, inputs=b"\0\5"))
            update = await anext(stream)
            (ints, floats) = update.changes
            assert (ints.column, ints.slots.tolist(), ints.values.tolist()) == (Column.INT32, [1], [5])
            assert (floats.column, floats.slots.tolist(), floats.values.tolist()) == (Column.FLOAT, [1], [3.0])
            assert update.changed == ["cell/axis/speed", "cell/inputs"]
            assert update["cell/axis/position"] == 1.0
            assert update["inputs"].tolist() == [0, 5]
            assert update.table.arrays[Column.FLOAT].tolist() == [1.0, 3.0]
            update = await anext(stream)
            assert (update.frame, update.missed, update.changes) == (3, 0, ())
        with pytest.raises(StopAsyncIteration):
            await anext(stream)

    with_client(segment, connects, test)


@BOTH
@pytest.mark.parametrize("whole", [False, True], ids=["the stream", "the client"])
def test_closing_ends_a_subscription_that_is_waited_for(segment: Segment, connects: Connect, whole: bool) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        served.publish(image())
        stream = cell.subscribe("cell/axis")
        await anext(stream)
        waiting = asyncio.create_task(anext(stream))
        await asyncio.sleep(0)
        if whole:
            await cell.close()
        else:
            stream.close()
        with pytest.raises(StopAsyncIteration):
            await waiting

    with_client(segment, connects, test)


def test_waiting_for_an_update_can_be_cancelled(segment: Segment) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        served.publish(image())
        async with cell.subscribe("cell/axis") as stream:
            await anext(stream)
            waiting = asyncio.create_task(anext(stream))
            await asyncio.sleep(0)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting

    with_client(segment, connect_aio, test)


@BOTH
def test_raw_frames_are_decoded_by_the_layout(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint, cell: Any) -> None:
        served.writer.publish(image(1.5, 2.5, True, b"\1\2", -7), cycle=1, effective=image(9.0))
        layout = (await cell.layouts("cell"))["cell"]
        assert layout.size == LAYOUT.size
        async with cell.subscribe("cell", frames=True) as stream:
            update = await anext(stream)
        assert layout.array(update.image)["axis/position"] == 9.0
        record = layout.array(update.raw)
        assert [record[name].tolist() for name in ("axis/position", "step", "inputs")] == [1.5, -7, [1, 2]]
        assert layout.value(update.raw, "cell/running")
        assert layout.value(update.raw, "bits").tolist() == [False] * 10
        assert len(layout.value(update.raw, "name").tobytes()) == 10
        with pytest.raises(PathError):
            layout.value(update.raw, "nothing")
        with pytest.raises(ValueError, match="a frame has 628 bytes, but the image has 1"):
            layout.array(b"x")

    with_client(segment, connects, test)


@BOTH
def test_errors_are_those_of_a_local_program(segment: Segment, connects: Connect) -> None:
    async def test(_: Endpoint, cell: Any) -> None:
        with pytest.raises(PathError, match="no such register"):
            await cell.read("cell/nothing")
        with pytest.raises(ValueRangeError, match="no pattern is given"):
            await cell.read()
        with pytest.raises(PathError):
            async with cell.subscribe("cell/nothing") as stream:
                await anext(stream)
        with pytest.raises(PathError, match="unknown source 'x'"):
            await cell.layouts("x")

    with_client(segment, connects, test)


@BOTH
def test_too_large_message_is_refused_with_a_remedy(segment: Segment, connects: Connect) -> None:
    async def test(_: Endpoint, cell: Any) -> None:
        with pytest.raises(
            EndpointError, match=r"^the values are too large for one message; send or request fewer at once \("
        ):
            await cell.write({"cell/name": "x" * (2 << 20)})

    with_client(segment, connects, test)


@BOTH
def test_address_without_an_endpoint(connects: Connect) -> None:
    async def test() -> None:
        async with connects("127.0.0.1:1") as cell:
            with pytest.raises(RemoteError, match=r"^127\.0\.0\.1:1: no instance serves there"):
                await cell.read("cell")

    asyncio.run(test())


@pytest.mark.parametrize(
    ("serves", "ca", "told"),
    [
        ("tls", None, "or it speaks TLS; then name the CA"),
        ("mutual", "ca.pem", "or it needs a client certificate"),
        ("plain", "ca.pem", "the endpoint does not use TLS; leave the CA out"),
        ("tls", "other.pem", "its certificate is not from the CA given"),
        ("of another", "ca.pem", "its certificate does not name this host"),
    ],
)
def test_tls_faults_are_named(tmp_path: Path, serves: str, ca: str | None, told: str) -> None:
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    trustme.CA().cert_pem.write_to_path(tmp_path / "other.pem")
    own = authority.issue_cert("elsewhere.example" if serves == "of another" else "127.0.0.1")
    known = [(own.private_key_pem.bytes(), own.cert_chain_pems[0].bytes())]
    mutual = serves == "mutual"
    server = grpc.server(ThreadPoolExecutor(1))
    if serves == "plain":
        port = server.add_insecure_port("127.0.0.1:0")
    else:
        asked = authority.cert_pem.bytes() if mutual else None
        port = server.add_secure_port("127.0.0.1:0", grpc.ssl_server_credentials(known, asked, mutual))
    server.start()
    address = f"127.0.0.1:{port}"
    try:
        with (
            connect(address, ca=ca and tmp_path / ca) as cell,
            pytest.raises(LostError, match=rf"^{address}: .*{told}"),
        ):
            cell.status()
    finally:
        server.stop(None).wait()


@BOTH
def test_lost_stream_that_had_answers_needs_no_other_settings(segment: Segment, connects: Connect) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(1.5, 2.5, True, b"", 0))
        with FaultProxy(Address("127.0.0.1", served.port), framing=None) as proxy:
            async with connects(str(proxy.address)) as cell, cell.subscribe("cell/axis") as stream:
                await anext(stream)
                proxy.cut()
                with pytest.raises(LostError, match="the endpoint has stopped") as caught:
                    await anext(stream)
        assert "TLS" not in str(caught.value)

    serve(segment, test)


def test_token_for_another_host_needs_tls() -> None:
    for connects in (connect, connect_aio):
        with pytest.raises(ValueRangeError, match=r"^plant\.example:8089: shmio does not send a token to another host"):
            connects("plant.example:8089", token="secret")
    for address in ("127.0.0.2:8089", "[::1]:8089", "localhost:8089", "unix:/run/shmio.sock"):
        connect(address, token="secret").close()
    connect("plant.example:8089", token="secret", token_in_plain_text=True).close()


@BOTH
def test_status(segment: Segment, connects: Connect) -> None:
    async def test(_: Endpoint, cell: Any) -> None:
        status = await cell.status()
        assert (status["instance"], status["mode"]) == (segment.instance, "live")
        assert {"state", "segment", "segment_bytes", "supervisor", "processes", "note"} <= set(status)

    with_client(segment, connects, test)
