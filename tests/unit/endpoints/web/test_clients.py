"""The clients of endpoints, as the kernel's tables have them."""

from __future__ import annotations

import os
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest

from shmio.endpoints.web.clients import clients


def listening(stack: ExitStack, family: socket.AddressFamily, address: object) -> socket.socket:
    server = stack.enter_context(socket.socket(family))
    server.bind(address)  # type: ignore[arg-type]
    server.listen()
    return server


def accept(stack: ExitStack, server: socket.socket) -> None:
    client = stack.enter_context(socket.socket(server.family))
    client.connect(server.getsockname())
    stack.enter_context(server.accept()[0])


@pytest.mark.parametrize(
    ("family", "address"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::"), (socket.AF_UNIX, "grpc.sock")]
)
def test_connections_of_an_endpoint_are_counted(family: socket.AddressFamily, address: str, tmp_path: Path) -> None:
    with ExitStack() as stack:
        here = str(tmp_path / address) if family is socket.AF_UNIX else (address, 0)
        server = listening(stack, family, here)
        [none] = clients({"grpc": ("grpc", os.getpid())})
        assert none == {"endpoint": "grpc", "connections": 0, "clients": []}
        for _ in range(2):
            accept(stack, server)
        [found] = clients({"grpc": ("grpc", os.getpid())})
        # The clients are in the same process, which the table names.
        who = "UNIX socket" if family is socket.AF_UNIX else "grpc"
        assert found == {"endpoint": "grpc", "connections": 2, "clients": [{"client": who, "connections": 2}]}


def test_other_processes_have_no_clients() -> None:
    with ExitStack() as stack:
        listening(stack, socket.AF_INET, ("127.0.0.1", 0))
        assert clients({"cell": ("source", os.getpid())}) == []
        assert clients({"grpc": ("grpc", 2**22)}) == []  # it has ended
