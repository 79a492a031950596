"""Emulated controllers for tests of the client."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from shmio.config.address import Address
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.testing.proxy import FaultProxy
from tests.unit.connectors.s7.harness import SIZE, MakePlc, Plc


@pytest.fixture
def make_plc() -> Iterator[MakePlc]:
    """Return a function that starts a controller with the given properties."""
    with ExitStack() as stack:

        def make(options: ServerOptions, kind: type[S7Server] = S7Server) -> Plc:
            block = bytearray(os.urandom(SIZE))
            server = stack.enter_context(kind(Address("127.0.0.1", 0), options=options))
            server.add_block(201, block)
            server.start()
            plc = Plc(server, block, stack.enter_context(FaultProxy(server.address)))
            stack.callback(plc.close)
            return plc

        yield make


@pytest.fixture
def plc(make_plc: MakePlc) -> Plc:
    return make_plc(ServerOptions())
