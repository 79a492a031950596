"""More connections than the endpoint has descriptors for. The test lowers the limit of descriptors at run time."""

from __future__ import annotations

import resource
import socket
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import grpc
import pytest

from shmio.testing.cell import PATIENCE_S, Cell, until
from shmio.wire.simlog_v1_pb2 import ROSMessage, TopicDescriptor

SUBSCRIBE = "/simulation.server.SimlogAPI/Subscribe"
TOPIC = TopicDescriptor(path="cell/Robot_800/Axs1_Pos")  # changes all the time
FEW = 5


@pytest.fixture
def cell(make_cell: Callable[..., Cell]) -> Cell:
    cell = make_cell()
    cell.up()
    until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")
    return cell


def test_without_free_descriptors_streams_continue_and_new_clients_wait(cell: Cell) -> None:
    pid: int = cell.processes()["grpc"]["pid"]
    with ExitStack() as stack:
        channel = stack.enter_context(grpc.insecure_channel(str(cell.grpc)))
        subscribe = channel.unary_stream(SUBSCRIBE, TopicDescriptor.SerializeToString, ROSMessage.FromString)
        stream = subscribe(TOPIC, timeout=PATIENCE_S)
        next(stream)
        open_now = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        _, hard = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (open_now + FEW, hard))
        others = [stack.enter_context(socket.create_connection((cell.grpc.host, cell.grpc.port))) for _ in range(50)]
        until(lambda: len(list(Path(f"/proc/{pid}/fd").iterdir())) >= open_now + FEW, "there are no more descriptors")
        for _ in range(100):
            assert next(stream).value
        for other in others:
            other.close()
        again = stack.enter_context(
            grpc.insecure_channel(
                str(cell.grpc), [("grpc.use_local_subchannel_pool", 1), ("grpc.max_reconnect_backoff_ms", 200)]
            )
        )
        subscribe = again.unary_stream(SUBSCRIBE, TopicDescriptor.SerializeToString, ROSMessage.FromString)
        assert next(subscribe(TOPIC, timeout=PATIENCE_S, wait_for_ready=True)).value
        stream.cancel()
    assert cell.processes()["grpc"]["pid"] == pid
    assert cell.processes()["grpc"]["restarts"] == 0
