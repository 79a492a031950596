"""A cell with its own broker: what MQTT clients and the user of the cell see."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from shmio.config import Address
from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.mosquitto import missing
from shmio.testing.ports import reserved_port
from shmio.wire.sparkplug_b_pb2 import Metric, Payload
from tests.unit.endpoints.mqtt.harness import Listener, listening

MQTT = """
[mqtt]
listen = "{broker}"
prefix = "shmio/test"
"""
EVERYBODY = '[[mqtt.account]]\nroles = ["read", "write"]\n'
SOURCE = 'connector = "s7"\n'
WHO = (("anna", "secret"), ("bert", "hidden"))
REBIRTH = Payload(metrics=[Metric(name="Node Control/Rebirth", boolean_value=True)]).SerializeToString()


@pytest.fixture
def broker() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


@contextmanager
def running(make_cell: Callable[..., Cell], broker: Address, *, more: str = "") -> Iterator[Cell]:
    config = CONFIG.replace(SOURCE, f'{SOURCE}writable = ["Outputs"]\n') + MQTT.replace("{broker}", str(broker)) + more
    cell = make_cell(config=config)
    cell.up()
    yield cell


def counts(listener: Listener, topic: str, count: int) -> None:
    for _ in range(count):
        listener.until(topic)


def test_clients_read_and_command_the_cell(make_cell: Callable[..., Cell], broker: Address, program: str) -> None:
    with running(make_cell, broker, more=f'broker = "{program}"\n{EVERYBODY}') as cell:
        assert cell.status()["state"] == "running", cell.logs()
        with listening(broker, protocol=4) as listener:
            counts(listener, "cell/Robot_800/Axs1_Pos/out", 10)
            listener.publish("cell/Outputs/13/in", "1")
            assert listener.json("cell/Outputs/13/in/result")["done"]
            while not any(json.loads(value)[13] == 1 for value in listener.values("cell/Outputs/out")):
                listener.message()
            cell.down()
            listener.until("status", b"offline")
    assert not list(Path(os.environ.get("XDG_RUNTIME_DIR", "/tmp")).glob(f"shmio*/{cell.instance}*"))


def test_a_killed_broker_is_restarted_and_its_bridge_continues(
    make_cell: Callable[..., Cell], broker: Address, program: str
) -> None:
    with running(make_cell, broker, more=f'broker = "{program}"\n{EVERYBODY}') as cell:
        before = cell.processes()
        kill(before["broker"]["pid"])
        until(lambda: cell.processes()["broker"]["restarts"] == 1, "the broker's restart")
        until(lambda: cell.processes()["mqtt"]["counters"]["connects"] == 2, "the bridge's reconnection")
        until(lambda: cell.status()["state"] == "running", "no problem")
        with listening(broker, protocol=4) as listener:
            counts(listener, "cell/Robot_800/Axs1_Pos/out", 3)
        for name in ("mqtt", "grpc", "cell", "plc"):
            assert cell.processes()[name]["pid"] == before[name]["pid"]


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_a_killed_edge_node_leaves_its_will_and_sends_a_new_birth(
    make_cell: Callable[..., Cell], broker: Address
) -> None:
    def told(listener: Listener, kind: str) -> Payload:
        while (message := listener.message()).topic != f"spBv1.0/plant/{kind}":
            pass
        return Payload.FromString(bytes(message.payload))

    def session(payload: Payload) -> int:
        return next(metric.long_value for metric in payload.metrics if metric.name == "bdSeq")

    more = (
        EVERYBODY + '[[mqtt.topic]]\nmatch = "**"\npublish = false\n[mqtt.sparkplug]\ngroup = "plant"\nnode = "a50"\n'
    )
    with running(make_cell, broker, more=more) as cell, listening(broker, "spBv1.0/#") as listener:
        names = {}
        listener.client.publish("spBv1.0/plant/NCMD/a50", REBIRTH, 0)
        first = session(told(listener, "NBIRTH/a50"))
        for metric in told(listener, "DBIRTH/a50/cell").metrics:
            names[metric.alias] = metric.name
        assert "Robot_800/Axs1_Pos" in {names[metric.alias] for metric in told(listener, "DDATA/a50/cell").metrics}
        kill(cell.processes()["mqtt"]["pid"])
        assert session(told(listener, "NDEATH/a50")) == first
        assert session(told(listener, "NBIRTH/a50")) != first
        told(listener, "DBIRTH/a50/cell")
        cell.down()
        told(listener, "NDEATH/a50")


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_accounts_can_do_only_what_their_roles_allow(
    make_cell: Callable[..., Cell], broker: Address, tmp_path: Path
) -> None:
    (tmp_path / "accounts").write_text("anna:secret\nbert:hidden\n")
    (tmp_path / "accounts").chmod(0o600)
    more = f'password_file = "accounts"\n{EVERYBODY}name = "bert"\n'
    viewer, writer = (dict(zip(("username", "password"), one, strict=True)) for one in WHO)
    with running(make_cell, broker, more=more) as cell:
        with (
            listening(broker, protocol=4, **viewer) as listener,
            listening(broker, "none", protocol=4, **viewer) as forger,
            listening(broker, "none", protocol=4, **writer) as operator,
        ):
            counts(listener, "cell/Robot_800/Axs1_Pos/out", 3)
            for topic in (
                "cell/Outputs/13/in",
                "cell/Outputs/out",
                "cell/status",
                "status",
                "cell/Outputs/13/in/result",
            ):
                forger.publish(topic, "999", retain=True)
            operator.publish("cell/Outputs/13/in", "1")
            assert listener.json("cell/Outputs/13/in/result")["done"]
            while not any(json.loads(value)[13] == 1 for value in listener.values("cell/Outputs/out")):
                listener.message()
            assert b"999" not in [payload for _, payload in listener.heard]
        client_id = f"shmio-{cell.instance}"
        for taken in (client_id, f"{client_id}-commands"):
            assert connected(broker, taken, **viewer) == 0
        with (
            listening(broker, protocol=4, **viewer) as listener,
            listening(broker, "none", protocol=4, **writer) as operator,
        ):
            operator.publish("cell/Outputs/13/in", "0")
            assert listener.json("cell/Outputs/13/in/result")["done"]
            counts(listener, "cell/Robot_800/Axs1_Pos/out", 3)
            assert b"999" not in [payload for _, payload in listener.heard]
        told: dict[str, int] = {}

        def both_commands() -> bool:
            told.update(cell.processes()["mqtt"]["counters"])
            return told["commands"] >= 2

        until(both_commands, "the bridge reports both commands")
        assert told["connects"] == 1, "no other client has taken over its session"
        for account in ({}, {"username": "anna", "password": "guess"}):
            assert connected(broker, "me", **account) in (4, 5)


def connected(broker: Address, client_id: str, **account: str) -> int:
    """Return the return code that the broker sends to an MQTT 3.1.1 client. 0 means accepted."""
    who = b"".join(len(text).to_bytes(2, "big") + text.encode() for text in (client_id, *account.values()))
    flags = 0xC2 if account else 2
    variable = b"\0\x04MQTT\x04" + bytes([flags]) + b"\0\x3c" + who
    with socket.create_connection((broker.host, broker.port), timeout=30) as client:
        client.sendall(bytes([0x10, len(variable)]) + variable)
        answer = client.recv(4)
    assert answer[:3] == b"\x20\x02\x00"
    return answer[3]


def test_an_occupied_port_is_reported_before_anything_starts(make_cell: Callable[..., Cell], broker: Address) -> None:
    with socket.create_server((broker.host, broker.port)):
        cell = make_cell(config=CONFIG + MQTT.replace("{broker}", str(broker)) + EVERYBODY)
        done = cell.supervisor("up", "--detach")
    assert done.returncode == 1
    assert f"broker: cannot listen on {broker}" in done.stderr
