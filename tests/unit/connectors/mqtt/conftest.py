"""A mosquitto and a device made with Node's mqtt, for all tests of a module."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import pytest

from shmio.config import Address
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port
from tests.unit.connectors.mqtt.peer import Peer


class Plant(NamedTuple):
    """A broker, and a device that is connected to it."""

    address: Address
    device: Peer


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    if reason := missing():
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("mosquitto")
    (folder / "acl").write_text("topic readwrite #\ntopic deny fixed/#\n")
    with reserved_port() as address, Peer() as device:
        broker = Mosquitto(folder, address, "allow_anonymous true", f"acl_file {folder / 'acl'}")
        broker.start()
        try:
            device.ask("connect", address.port, {"protocolVersion": 5})
            yield Plant(address, device)
        finally:
            broker.stop()
