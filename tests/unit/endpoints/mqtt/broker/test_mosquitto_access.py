"""Access rights at the broker that shmio starts, which is mosquitto in these tests."""

from __future__ import annotations

import stat
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import topic_matches_sub

from shmio.config import Address, Mqtt, MqttAccount
from shmio.endpoints.mqtt.broker.directory import SECRET, folder, secret_id
from shmio.endpoints.mqtt.broker.mosquitto import rights
from shmio.segment import Segment
from shmio.testing.mosquitto import missing
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import PREFIX, Listener, Running, listening
from tests.unit.endpoints.mqtt.serving import Raw, bridged, serving
from tests.unit.endpoints.mqtt.serving import address as address  # noqa: PLC0414  the fixture
from tests.unit.endpoints.mqtt.serving import segment as segment  # noqa: PLC0414  the fixture

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())

VIEWER, WRITER, NEW = ("viewer", "seen"), ("writer", "done"), ("new", "here")
ACCOUNTS = [
    {"name": "viewer", "roles": ["read"]},
    {"name": "writer", "roles": ["read", "write"], "publish": ["mine/#"]},
]
FORGED = [
    f"{PREFIX}/cell/step/out",
    f"{PREFIX}/cell/status",
    f"{PREFIX}/status",
    f"{PREFIX}/cell/step/in/result",
    f"{PREFIX}/shmio/results/me",
    f"{PREFIX}/simlog/step",
    f"{PREFIX}/cell/frames",
    "spBv1.0/plant/NDEATH/a50",
    "spBv1.0/plant/DDATA/a50/cell",
]
COMMANDS = [f"{PREFIX}/cell/secret/in", "spBv1.0/plant/NCMD/a50", "spBv1.0/STATE/scada"]


class Cell:
    """A broker with accounts, its bridge, and a client that receives everything."""

    def __init__(self, running: Running, listener: Listener, address: Address) -> None:
        self.running, self.listener, self.address = running, listener, address

    def client(self, name: str, account: tuple[str, ...], **how: Any) -> Raw:
        client = Raw(self.address, name, account=account, **how)
        assert client.code == 0
        return client

    def unforged(self, segment: Segment, connects: int = 1) -> None:
        """Assert that no client received a forged message, and that the bridge still publishes."""
        segment.writer("cell").publish(image(step=8), cycle=2)
        self.listener.until("cell/step/out", b"8")
        for topic in FORGED:
            assert b"forged" not in [payload for heard, payload in self.listener.heard if heard == topic]
        assert set(self.listener.values("status")) == {"online"}
        with listening(self.address, protocol=4, username="viewer", password="seen") as later:
            later.until("cell/step/out", b"8")
            assert b"forged" not in [payload for _, payload in later.heard]
        assert self.running.bridge.connection.connects == connects


Cells = Callable[..., AbstractContextManager[Cell]]


@pytest.fixture
def cells(segment: Segment, address: Address, tmp_path: Path) -> Cells:
    return partial(_cell, segment, address, tmp_path)


@contextmanager
def _cell(segment: Segment, address: Address, folder: Path, **config: Any) -> Iterator[Cell]:
    passwords = folder / "accounts"
    passwords.write_text("".join(f"{name}:{password}\n" for name, password in (VIEWER, WRITER, NEW)))
    passwords.chmod(0o600)
    config = {
        "account": ACCOUNTS,
        "password_file": str(passwords),
        "sparkplug": {"group": "plant", "node": "a50"},
    } | config
    with (
        serving(segment, address, **config),
        bridged(segment) as running,
        listening(address, protocol=4, username="viewer", password="seen") as listener,
    ):
        listener.until("cell/step/out", b"7")
        yield Cell(running, listener, address)


@pytest.mark.parametrize("account", [VIEWER, NEW])
def test_an_account_that_may_read_cannot_publish(cells: Cells, segment: Segment, account: tuple[str, str]) -> None:
    with cells() as cell:
        with cell.client("me", account) as client:
            for topic in FORGED + COMMANDS:
                for retain in (True, False):
                    client.publish(topic, b"forged", retain=retain)
            client.publish(f"{PREFIX}/status", b"", retain=True)
            client.publish(f"{PREFIX}/cell/step/out", b"", qos=1, retain=True)
            client.ping()
        cell.unforged(segment)
        assert not cell.listener.values("cell/secret/in/result")


def test_an_account_that_may_write_publishes_commands_but_no_values(cells: Cells, segment: Segment) -> None:
    with cells() as cell:
        with cell.client("me", WRITER) as client:
            for topic in FORGED:
                client.publish(topic, b"forged", retain=True)
            client.ping()
            client.publish("mine/own", b"1")
            client.publish(f"{PREFIX}/cell/secret/in", b"5")
            assert "not writable" in cell.listener.json("cell/secret/in/result")["reason"]
        cell.unforged(segment)


def test_a_last_will_is_published_where_its_client_may_publish(cells: Cells, segment: Segment) -> None:
    with cells() as cell:
        for number, topic in enumerate(FORGED):
            with cell.client(f"v{number}", VIEWER, will=(topic, "forged")):
                pass
        with cell.client("w", WRITER, will=("mine/will", "left")):
            pass
        while cell.listener.message().topic != "mine/will":
            pass
        with cell.client("after", VIEWER) as client:
            client.ping()
        cell.unforged(segment)


@pytest.mark.parametrize("topic", ["$SYS/broker/version", "$share/group/mine/own", f"$share/g/{PREFIX}/status"])
def test_no_client_can_publish_on_reserved_topics(cells: Cells, segment: Segment, topic: str) -> None:
    with (
        cells() as cell,
        cell.client("me", WRITER) as client,
        listening(cell.address, topic, protocol=4, username="viewer", password="seen") as listener,
    ):
        client.publish(topic, b"forged", retain=True)
        client.ping()
        cell.unforged(segment)
        listener.taken()
        assert b"forged" not in [payload for _, payload in listener.heard]


def test_no_other_client_can_connect_as_the_bridge(
    cells: Cells, segment: Segment, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    with cells() as cell:
        name = f"shmio-{segment.instance}"
        for suffix in ("", "-commands", "-sparkplug"):
            with cell.client(name + suffix, WRITER):
                pass
        cell.unforged(segment)
        place = folder(segment)
        secret = (place / SECRET).read_text()
        with Raw(cell.address, "me", account=("bridge", secret)) as client:
            assert client.code == 5, "the bridge's account works only on its own socket"
        assert f"the bridge is connected to broker of this instance as {name}," in caplog.text
        assert secret_id(name, secret) not in caplog.text
        for file in place.iterdir():
            mode = file.stat().st_mode
            assert stat.S_ISSOCK(mode) or stat.S_IMODE(mode) == 0o600, file


def test_without_accounts_every_client_may_read_only(segment: Segment, address: Address) -> None:
    with serving(segment, address, account=[]), bridged(segment):
        for account in ((), ("any", "body")):
            with Raw(address, "me", account=account) as client:
                client.publish(f"{PREFIX}/cell/step/out", b"forged", retain=True)
                client.ping()
        with listening(address, protocol=4) as listener:
            assert listener.until("cell/step/out") == b"7"


def test_a_client_without_an_account_has_the_roles_configured_for_it(cells: Cells) -> None:
    rules = [{"roles": ["read"]}, {"name": "new", "roles": ["write"]}]
    with cells(account=rules) as cell:
        with cell.client("guest", ()) as client:
            client.publish(f"{PREFIX}/cell/secret/in", b"5")
            client.ping()
        with Raw(cell.address, "guess", account=("new", "guess")) as client:
            assert client.code == 5
        with cell.client("new", NEW) as client:
            client.publish(f"{PREFIX}/cell/secret/in", b"6")
            cell.listener.json("cell/secret/in/result")
        assert len(cell.listener.values("cell/secret/in/result")) == 1


@pytest.mark.parametrize(
    ("topic", "may"),
    [
        ("a/b/cell/x/in", True),
        ("a/b/cell/x/1/2/in", True),
        ("a/b/cell/in", False),
        ("a/b/cell/x/out", False),
        ("a/b/cell/x/in/result", False),
        ("a/b/cell/x\n/in", True),
        ("x/a/b/cell/x/in", False),
        ("mine", True),
        ("mine/x/y", True),
        ("minex", False),
    ],
)
def test_topics_that_the_role_write_allows(topic: str, may: bool) -> None:
    settings = Mqtt(prefix="a/b", account=[MqttAccount(roles=["write"], publish=["mine/#"])])
    filters = rights(settings, "i", None)[None].filters
    assert any(topic_matches_sub(one, topic) for one in filters) is may
