"""An emulated controller behind a proxy, and S7 clients that connect to it."""

from __future__ import annotations

from contextlib import ExitStack, closing
from typing import Protocol

import pytest

from shmio.connectors.s7 import S7Client, S7Options
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.errors import ConnectorError
from shmio.testing.proxy import FaultProxy

SIZE = 2180


class Plc:
    """An emulated controller with DB201 of random bytes, behind a proxy."""

    def __init__(self, server: S7Server, block: bytearray, proxy: FaultProxy) -> None:
        self.server = server
        self.block = block
        self.proxy = proxy
        self._stack = ExitStack()

    def client(self, *, size: int = SIZE, db_number: int = 201, **options: object) -> S7Client:
        address = self.proxy.address
        given: dict[str, object] = {"host": address.host, "port": address.port, "timeout": 5000, "maxJobs": 24}
        client = S7Client(S7Options(**{**given, **options}), db_number, size)  # type: ignore[arg-type]
        return self._stack.enter_context(closing(client))

    def connected(self, *, size: int = SIZE, **options: object) -> S7Client:
        client = self.client(size=size, **options)  # type: ignore[arg-type]
        client.connect()
        return client

    def close(self) -> None:
        self._stack.close()


class MakePlc(Protocol):
    def __call__(self, options: ServerOptions, kind: type[S7Server] = S7Server) -> Plc: ...


def assert_recovers(plc: Plc, client: S7Client) -> None:
    """Assert that the error has closed the client, and that it connects and reads again without the fault."""
    assert not client.connected
    with pytest.raises(ConnectorError, match="not connected"):
        client.read()
    plc.proxy.pass_all()
    client.connect()
    assert client.read() == plc.block
