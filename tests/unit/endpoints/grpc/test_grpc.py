"""The gRPC endpoint over real sockets: the test publishes into a segment, and a client receives."""

from __future__ import annotations

import asyncio
from collections.abc import Sized
from pathlib import Path
from typing import Any

import grpc
import pytest
import trustme
from grpc_health.v1 import health_pb2
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from shmio.config import Address, Tls
from shmio.endpoints.grpc.encoding import Subject
from shmio.endpoints.grpc.server.server import Server
from shmio.endpoints.grpc.streams.outbox import Outbox
from shmio.errors import ConfigError, EndpointError
from shmio.segment import Quality, Segment
from shmio.wire import simlog_v1_pb2 as wire
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from tests.unit.endpoints.harness import (
    LAYOUT,
    LOOPBACK,
    SOON_STALE_NS,
    TIMEOUT_S,
    Endpoint,
    code,
    image,
    listening,
    serve,
    value,
)


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("cell/axis/position", "double"),
        ("axis/position", "double"),
        ("/cell/axis/position/out", "double"),
        ("CELL://axis/position/in", "double"),
        ("cell/running", "bool"),
        ("cell/step", "int"),
        ("cell/inputs/1", "int"),
    ],
)
def test_get_topic_returns_the_type(segment: Segment, path: str, kind: str) -> None:
    async def test(served: Endpoint) -> None:
        answer = await served.stub.GetTopic(wire.TopicDescriptor(path=path), timeout=TIMEOUT_S)
        assert (answer.path, answer.msgType) == (path, kind)

    serve(segment, test)


@pytest.mark.parametrize(
    "path",
    ["", "/", "cell/nothing", "nothing", "cell/inputs/2", "model/time", "SIMLOG://step/in", "X://a", "%", "a//b"],
)
def test_an_unknown_topic_is_not_found(segment: Segment, path: str) -> None:
    async def test(served: Endpoint) -> None:
        topic = wire.TopicDescriptor(path=path)
        assert await code(served.stub.GetTopic(topic, timeout=TIMEOUT_S)) is grpc.StatusCode.NOT_FOUND
        assert await code(served.subscribe(path).read()) is grpc.StatusCode.NOT_FOUND

    serve(segment, test)


def test_a_structure_is_refused(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        topic = wire.TopicDescriptor(path="cell/axis")
        assert await code(served.stub.GetTopic(topic, timeout=TIMEOUT_S)) is grpc.StatusCode.INVALID_ARGUMENT

    serve(segment, test)


def test_a_subscriber_gets_the_current_value_then_every_change(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(position=0.1))
        stream = served.subscribe("cell/axis/position")
        first = await asyncio.wait_for(stream.read(), TIMEOUT_S)
        assert (first.type, first.value) == ("double", "0.1")
        served.publish(image(position=0.1, speed=5.0))
        served.publish(image(position=-0.0, speed=5.0))
        served.publish(image(position=float("nan")))
        served.publish(image(position=2.0))
        assert [await value(stream) for _ in range(3)] == ["-0.0", "NaN", "2.0"]
        stream.cancel()

    serve(segment, test)


def test_the_nsec_field_has_all_nanoseconds_since_the_start(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image())
        frame = served.feeds["cell"].block.latest()
        assert frame is not None
        stream = served.subscribe("cell/step")
        message = await asyncio.wait_for(stream.read(), TIMEOUT_S)
        stamp = message.timeStamp.stamp
        assert (stamp.nsec, stamp.sec) == (frame.clock_ns, frame.clock_ns // 10**9)
        stream.cancel()

    serve(segment, test)


def test_bits_arrays_and_elements(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(inputs=b"\x01\x02"))
        streams = [served.subscribe(path) for path in ("cell/running", "cell/inputs", "cell/inputs/1")]
        assert [await value(stream) for stream in streams] == ["false", "[1,2]", "2"]
        served.publish(image(running=True, inputs=b"\x01\xff"))
        assert [await value(stream) for stream in streams] == ["true", "[1,255]", "255"]
        for stream in streams:
            stream.cancel()

    serve(segment, test)


def test_no_value_is_sent_while_bad_and_it_is_sent_again_on_recovery(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        stream = served.subscribe("cell/step")
        assert await value(stream) == "1"
        served.publish(image(step=2), Quality.BAD)
        served.publish(image(step=1))
        served.publish(image(step=3))
        assert [await value(stream) for _ in range(2)] == ["1", "3"]
        stream.cancel()

    serve(segment, test)


def test_a_subscriber_of_a_bad_source_waits_for_it(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=7), Quality.BAD)
        stream = served.subscribe("cell/step")
        await served.until(lambda: listening(served, 1))
        served.publish(image(step=8))
        assert await value(stream) == "8"
        stream.cancel()

    serve(segment, test)


def test_health_follows_quality_and_age(soon_stale: Segment) -> None:
    async def test(served: Endpoint) -> None:
        serving, not_serving = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING

        async def is_now(status: int, quality: Quality | None = None) -> bool:
            if quality is not None:
                served.publish(image(), quality)
            return await served.health("source.cell") == status

        assert await served.health("") == serving
        assert await served.health("simulation.server.SimlogAPI") == serving
        assert await served.health("source.cell") == not_serving
        await served.until(lambda: is_now(serving, Quality.GOOD))
        await served.until(lambda: is_now(not_serving, Quality.BAD))
        await served.until(lambda: is_now(serving, Quality.GOOD))
        await served.until(lambda: is_now(not_serving))  # no frame for longer than stale_ns

    serve(soon_stale, test)


def test_a_stale_value_is_sent_again_when_frames_resume(soon_stale: Segment) -> None:
    async def test(served: Endpoint) -> None:
        serving, not_serving = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING
        stream = served.subscribe("cell/step")

        async def good() -> bool:
            served.publish(image(step=5))
            return await served.health("source.cell") == serving

        async def stale() -> bool:
            return await served.health("source.cell") == not_serving

        async def sent(count: int) -> bool:
            served.publish(image(step=5))
            await asyncio.sleep(0)
            return len(got) >= count

        async def read() -> None:
            while True:
                got.append(await value(stream))

        got: list[str] = []
        reading = asyncio.ensure_future(read())
        await served.until(lambda: sent(1))
        for _ in range(3):
            await served.until(good)
            await served.until(stale)
            before = len(got)
            await served.until(lambda seen=before: sent(seen + 1))  # type: ignore[misc]
        assert set(got) == {"5"}
        reading.cancel()
        stream.cancel()

    serve(soon_stale, test)


def test_reflection_names_the_services(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        stub: Any = reflection_pb2_grpc.ServerReflectionStub(served.channel)  # type: ignore[arg-type]
        call = stub.ServerReflectionInfo(timeout=TIMEOUT_S)
        await call.write(reflection_pb2.ServerReflectionRequest(list_services=""))
        answer = await call.read()
        names = {service.name for service in answer.list_services_response.service}
        assert {"simulation.server.SimlogAPI", "grpc.health.v1.Health"} <= names
        await call.done_writing()

    serve(segment, test)


def test_a_stream_that_ends_leaves_no_listener_at_the_feed(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        served.publish(image(step=1))
        streams = [served.subscribe("cell/step") for _ in range(3)]
        assert [await value(stream) for stream in streams] == ["1", "1", "1"]
        streams[0].cancel()
        await served.until(lambda: listening(served, 2))
        served.publish(image(step=2))
        assert [await value(stream) for stream in streams[1:]] == ["2", "2"]
        for stream in streams[1:]:
            stream.cancel()
        await served.until(lambda: listening(served, 0))

    serve(segment, test)


def test_an_occupied_address_is_named_in_the_error(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        second = Server(served.service.calls)
        with pytest.raises(EndpointError, match=f"127.0.0.1:{served.port}"):
            await second.start([LOOPBACK._replace(address=Address("127.0.0.1", served.port))])
        await second.stop()

    serve(segment, test)


def test_tls_serves_clients_that_trust_the_certificate(segment: Segment, tmp_path: Path) -> None:
    authority = trustme.CA()
    server_cert, client_cert = authority.issue_cert("localhost"), authority.issue_cert("twin@example.org")
    server_cert.private_key_pem.write_to_path(tmp_path / "key.pem")
    server_cert.cert_chain_pems[0].write_to_path(tmp_path / "cert.pem")
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    tls = Tls(certificate=str(tmp_path / "cert.pem"), key=str(tmp_path / "key.pem"), client_ca=str(tmp_path / "ca.pem"))
    topic = wire.TopicDescriptor(path="cell/step")

    async def test(served: Endpoint) -> None:
        secure = Server(served.service.calls)
        (port,) = await secure.start([LOOPBACK._replace(address=Address("localhost", 0), encrypted=True)], tls)
        known = grpc.ssl_channel_credentials(
            authority.cert_pem.bytes(), client_cert.private_key_pem.bytes(), client_cert.cert_chain_pems[0].bytes()
        )
        anonymous = grpc.ssl_channel_credentials(authority.cert_pem.bytes())
        async with grpc.aio.secure_channel(f"localhost:{port}", known) as channel:
            stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            assert (await stub.GetTopic(topic, timeout=TIMEOUT_S)).msgType == "int"
        async with grpc.aio.secure_channel(f"localhost:{port}", anonymous) as channel:
            stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            assert await code(stub.GetTopic(topic, timeout=TIMEOUT_S)) is grpc.StatusCode.UNAVAILABLE
        unusable = Server(served.service.calls)
        with pytest.raises(ConfigError, match=r"grpc\.tls\.(key|certificate)"):
            await unusable.start([LOOPBACK], Tls(certificate="/nowhere", key="/nowhere"))
        await unusable.stop()
        await secure.stop()

    serve(segment, test)


STEP = Subject("raw", "step", (LAYOUT.registers[4],), lambda picture: picture.image[12:14])


class Recorder:
    """A listener that records messages and losses."""

    def __init__(self) -> None:
        self.since = 0
        self.stream = Outbox()
        self.got: list[Any] = []
        self.lost = 0

    def deliver(self, message: Sized, at_s: float | None = None) -> None:
        self.got.append(message)

    def keep(self, message: Sized) -> None:
        self.got.append(message)

    def lose(self) -> None:
        self.lost += 1


def test_a_subscriber_of_a_stale_source_gets_the_unchanged_value_when_frames_resume(soon_stale: Segment) -> None:
    async def test(served: Endpoint) -> None:
        feed = served.feeds["cell"]
        served.publish(image(step=7))
        frame = feed.block.latest()
        assert frame is not None
        while not frame.age_ns(feed.block.now_ns()) > SOON_STALE_NS:  # noqa: ASYNC110  waits until the frame is stale
            await asyncio.sleep(0.01)
        late = Recorder()
        feed.listen(STEP, late)
        assert late.got == []

        async def value_came() -> bool:
            served.publish(image(step=7))
            return bool(late.got)

        await served.until(value_came)
        assert set(late.got) == {b"\0\x07"}
        feed.leave(STEP, late)

    serve(soon_stale, test)


def test_queued_values_are_dropped_when_the_source_turns_bad(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        feed = served.feeds["cell"]
        served.publish(image(step=1))
        listener = Recorder()
        feed.listen(STEP, listener)
        served.publish(image(step=2), Quality.BAD)

        async def told() -> bool:
            return listener.lost > 0

        await served.until(told)
        served.publish(image(step=1))

        async def again() -> bool:
            return len(listener.got) >= 2

        await served.until(again)
        assert listener.got == [b"\0\x01"] * len(listener.got)
        feed.leave(STEP, listener)

    serve(segment, test)


def test_a_subscriber_that_joins_around_a_change_of_quality_gets_no_old_values(segment: Segment) -> None:
    async def test(served: Endpoint) -> None:
        feed = served.feeds["cell"]
        first = Recorder()
        served.publish(image(step=1))
        feed.listen(STEP, first)
        for step_now in (2, 3):
            served.publish(image(step=step_now))
        served.publish(image(step=3), Quality.BAD)
        for step_now in (4, 5, 6):
            served.publish(image(step=step_now))
        published = served.writer.block.ring.head()
        joiner = Recorder()
        feed.listen(STEP, joiner)
        assert joiner.since == published
        served.publish(image(step=7))

        async def seven() -> bool:
            return first.got[-1:] == [b"\0\x07"] and joiner.got[-1:] == [b"\0\x07"]

        await served.until(seven)
        assert joiner.got == [b"\0\x06", b"\0\x07"]
        assert first.got == sorted(first.got)
        for listener in (first, joiner):
            feed.leave(STEP, listener)

    serve(segment, test)
