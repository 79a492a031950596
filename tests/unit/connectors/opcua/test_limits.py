"""Servers with limits: of a call, of a subscription, of a session's time; the source reads all nodes nevertheless."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from shmio.errors import ConnectorError
from shmio.model.statuses import GOOD, RegisterStatus
from tests.unit.connectors.opcua.device import Device
from tests.unit.connectors.opcua.harness import Source, connected, until

TAGS: dict[str, Any] = {f"n{number}": {"type": "INT", "address": "ns=2;s=mode"} for number in range(47)}


@pytest.fixture(scope="module")
def limited() -> Iterator[Device]:
    with Device() as device:
        device.ask("add", "mode", "Int16", 3)
        yield device


@pytest.mark.parametrize("said", [True, False])
@pytest.mark.parametrize("mode", ["subscribe", "poll"])
def test_calls_and_subscriptions_are_as_large_as_the_server_takes(limited: Device, mode: str, said: bool) -> None:
    limited.ask("limit", 7, 10, said)
    with connected(limited.url, TAGS, mode=mode) as source:
        image = source.connector.read()
        assert {(source.value(path, image), source.status(path, image).code) for path in TAGS} == {(3, GOOD)}
        if mode == "subscribe":
            assert "5 subscriptions, sessions=1" in source.connector.describe()


def test_a_refused_subscription_is_named(limited: Device) -> None:
    limited.ask("refuse_subscriptions", 0x80770000)
    try:
        with pytest.raises(ConnectorError, match=r"no free resources \(BadTooManySubscriptions "):
            Source(limited.url, {"mode": "INT"}).connector.connect()
    finally:
        limited.ask("refuse_subscriptions", 0)


def test_values_that_come_while_other_nodes_are_subscribed_keep_their_status_and_time(limited: Device) -> None:
    limited.ask("limit", 1000, 1000, True)
    limited.ask("set", "mode", "Int16", 3, 0x40900000, 1_700_000_000)
    try:
        with connected(limited.url, TAGS, max_items=1) as source:
            image = source.connector.read()
            found = {source.status(path, image) for path in TAGS}
        assert found == {RegisterStatus(0x40900000, 1_700_000_000_000_000_000)}
    finally:
        limited.ask("set", "mode", "Int16", 3)


def test_a_refused_item_has_its_status_and_is_asked_for_again(limited: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.connectors.opcua.session.RETRY_S", 0.05)
    limited.ask("limit", 7, 0, True)
    with connected(limited.url, {"mode": "INT"}) as source:
        assert source.status("mode").code == 0x80DB0000
        limited.ask("limit", 7, 10, True)
        until(lambda: source.status("mode").code == GOOD and source.value("mode") == 3, "the value")
        assert "1 subscriptions" in source.connector.describe()
