"""One server for all tests that do not end it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.unit.connectors.opcua.device import Device


@pytest.fixture(scope="session")
def device() -> Iterator[Device]:
    with Device() as device:
        yield device
