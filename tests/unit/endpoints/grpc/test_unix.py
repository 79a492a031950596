"""The endpoint on a UNIX socket."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any
from urllib.parse import quote

import grpc
import pytest

from shmio.config import UnixAddress
from shmio.endpoints.grpc.server.access import Keys, Listener, ListenerAccess
from shmio.endpoints.grpc.server.server import Server
from shmio.errors import EndpointError
from shmio.segment import Segment
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from tests.unit.endpoints.harness import TIMEOUT_S, Endpoint, serve


@pytest.mark.parametrize("name", ["socket", "a name 100 % as # it may ? be"])
def test_it_serves_on_the_socket_and_removes_it_at_the_end(segment: Segment, tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    listener = Listener(UnixAddress(str(file)), ListenerAccess(Keys()))

    async def test(served: Endpoint) -> None:
        server = Server(served.service.calls)
        await server.start([listener])
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        async with grpc.aio.insecure_channel(f"unix:{quote(str(file))}") as channel:
            stub: Any = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            topic = await stub.GetTopic(TopicDescriptor(path="cell/step"), timeout=TIMEOUT_S)
            assert topic.msgType == "int"
            second = Server(served.service.calls)
            with pytest.raises(EndpointError, match="another program listens there"):
                await second.start([listener])
            await second.stop()
            await stub.GetTopic(TopicDescriptor(path="cell/step"), timeout=TIMEOUT_S)
        await server.stop()
        assert not file.exists()
        assert os.listdir(tmp_path) == []  # noqa: PTH208

    serve(segment, test)


def test_a_group_may_open_the_socket(segment: Segment, tmp_path: Path) -> None:
    file = tmp_path / "s"

    async def test(served: Endpoint) -> None:
        server = Server(served.service.calls)
        await server.start([Listener(UnixAddress(str(file)), ListenerAccess(Keys()))], gid=os.getegid())
        assert (stat.S_IMODE(file.stat().st_mode), file.stat().st_gid) == (0o660, os.getegid())
        await server.stop()

    serve(segment, test)
