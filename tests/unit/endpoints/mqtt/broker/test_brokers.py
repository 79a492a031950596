"""What clients see of the brokers that shmio starts: mosquitto and aMQTT."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
import trustme
from paho.mqtt.client import Client, MQTTv5, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion

from shmio.config import Address, Mqtt, MqttTls
from shmio.endpoints import server_process
from shmio.endpoints.mqtt.broker import mosquitto
from shmio.endpoints.mqtt.broker.directory import folder
from shmio.endpoints.mqtt.broker.program import choose_broker
from shmio.errors import ConfigError, EndpointError
from shmio.segment import Segment
from shmio.testing.cell import until
from shmio.testing.mosquitto import missing
from tests.unit.endpoints.mqtt.harness import PREFIX, bridge, listening
from tests.unit.endpoints.mqtt.serving import address as address  # noqa: PLC0414  the fixture
from tests.unit.endpoints.mqtt.serving import bridged, serving
from tests.unit.endpoints.mqtt.serving import segment as segment  # noqa: PLC0414  the fixture

MOSQUITTO = pytest.mark.skipif(bool(missing()), reason=missing())


def test_clients_receive_what_the_bridge_publishes(segment: Segment, address: Address, program: str) -> None:
    with serving(segment, address, program), bridged(segment) as running:
        assert running.bridge.connection.mqtt5 is (program == "mosquitto")
        with listening(address, protocol=MQTTv311) as listener:
            assert listener.until("cell/step/out") == b"7"
            listener.shown("cell/axis/position/out", "0.0")
    assert not folder(segment).exists()


@MOSQUITTO
def test_a_client_receives_only_its_subscriptions(segment: Segment, address: Address) -> None:
    with (
        serving(segment, address),
        bridged(segment),
        listening(address, protocol=MQTTv311) as everything,
    ):
        assert everything.until("cell/step/out") == b"7"
        with listening(address, f"{PREFIX}/mine", protocol=MQTTv311) as listener:
            listener.publish("mine", "last")
            listener.until("mine")
            assert listener.heard == [(f"{PREFIX}/mine", b"last")]


def test_a_retained_command_is_not_carried_out(segment: Segment, address: Address, program: str) -> None:
    with serving(segment, address, program):
        with listening(address, "none", protocol=MQTTv311) as before:
            before.publish("cell/step/in", "5", retain=True)
            before.publish("cell/step/in/result", "none")
        with bridged(segment) as running, listening(address, protocol=MQTTv311) as listener:
            listener.publish("cell/secret/in", "5")
            told = listener.json("cell/secret/in/result")
            assert "not writable" in told["reason"]
            assert (
                running.bridge.counters[2] >= 1
            )  # mosquitto does not report the retained command; aMQTT does, perhaps twice
            assert not any(json.loads(one)["done"] for one in listener.values("cell/step/in/result"))


def test_retained_topics_of_an_earlier_bridge_are_cleared(segment: Segment, address: Address, program: str) -> None:
    with serving(segment, address, program), listening(address, protocol=MQTTv311) as listener:
        listener.publish("cell/nowhere/out", "1", retain=True)
        listener.until("cell/nowhere/out", b"1")
        with bridged(segment):
            listener.until("cell/nowhere/out", b"")
            listener.shown("cell/step/out", "7")


@MOSQUITTO
def test_only_accounts_can_connect(segment: Segment, address: Address, tmp_path: Path) -> None:
    accounts = tmp_path / "accounts"
    accounts.write_text("anna:secret\n")
    accounts.chmod(0o600)
    with serving(segment, address, password_file=str(accounts), account=[]), bridged(segment):
        with listening(address, protocol=MQTTv311, username="anna", password="secret") as listener:
            assert listener.until("cell/step/out") == b"7"
        assert answer(address, MQTTv311) == "Not authorized"
        assert answer(address, MQTTv311, "anna", "guess") == "Not authorized"
        assert answer(address, MQTTv311, "bert", "secret") == "Not authorized"


def answer(address: Address, protocol: Any, *account: str) -> str:
    """Return the broker's answer to a client that connects."""
    told: list[str] = []
    client = Client(CallbackAPIVersion.VERSION2, protocol=protocol)
    if account:
        client.username_pw_set(*account)
    client.on_connect = lambda _client, _data, _flags, code, _properties: told.append(str(code))
    client.connect(address.host, address.port)
    while not told:
        client.loop(1.0)
    client.disconnect()
    client.loop(0.1)
    return told[0]


def test_amqtt_refuses_mqtt_5(segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    with serving(segment, address):
        assert answer(address, MQTTv5) == "Unsupported protocol version"
        assert answer(address, MQTTv311) == "Success"


@MOSQUITTO
def test_a_broker_that_hangs_is_killed_with_the_reason(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_process, "ASK_S", 0.02)
    monkeypatch.setattr(server_process, "LATE_S", 1.6)
    with serving(segment, address) as process:
        until(lambda: len(process.notes) > 10, "some answers: this takes longer than LATE_S")
        assert set(process.notes) == {""}
        [pid] = [int(one.name) for one in Path("/proc").glob("[0-9]*") if f"{folder(segment)}/" in command_line(one)]
        os.kill(pid, signal.SIGSTOP)
        until(lambda: "mosquitto has not answered for" in process.notes[-1], "the note")
        monkeypatch.setattr(server_process, "HANG_S", 0.8)
        until(lambda: process.failure is not None, "the broker's end")
        assert "mosquitto has not answered for" in process.notes[-1]
        assert "mosquitto hangs" in str(process.failure)
    assert not Path(f"/proc/{pid}").exists()
    assert not folder(segment).exists()


def command_line(process: Path) -> str:
    with suppress(OSError):
        return (process / "cmdline").read_text()
    return ""


@MOSQUITTO
def test_tls_with_certificates_of_both_sides(segment: Segment, address: Address, tmp_path: Path) -> None:
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    server, client = authority.issue_cert("127.0.0.1"), authority.issue_cert("bridge")
    for name, issued in (("server", server), ("client", client)):
        issued.private_key_pem.write_to_path(tmp_path / f"{name}.key")
        (tmp_path / f"{name}.pem").write_bytes(b"".join(blob.bytes() for blob in issued.cert_chain_pems))
    tls = {key: str(tmp_path / name) for key, name in (("certificate", "server.pem"), ("key", "server.key"))}
    own = MqttTls(
        ca=str(tmp_path / "ca.pem"), certificate=str(tmp_path / "client.pem"), key=str(tmp_path / "client.key")
    )
    with serving(segment, address, tls={**tls, "ca": str(tmp_path / "ca.pem")}):
        with bridge(segment, address, tls=own) as running:
            running.until(lambda: running.bridge.connection.up and not running.bridge.outbox.busy)
        trustme.CA().cert_pem.write_to_path(tmp_path / "other.pem")
        with bridge(segment, address, tls=MqttTls(ca=str(tmp_path / "other.pem"))) as running:
            running.until(lambda: "its certificate is not trusted" in running.bridge.problem)
        with bridge(segment, address, tls=MqttTls(ca=str(tmp_path / "ca.pem"))) as running:
            running.until(lambda: "mqtt.tls.certificate and key" in running.bridge.problem)
            assert not running.bridge.connection.up
        with bridge(segment, address) as running:
            running.until(lambda: "expects TLS there" in running.bridge.problem)
    with bridge(segment, address, tls=MqttTls(ca=str(tmp_path / "none.pem"))) as running:
        running.until(lambda: "mqtt.tls.ca" in running.bridge.problem)


def test_an_occupied_port_ends_the_broker_with_the_reason(segment: Segment, program: str) -> None:
    with (
        Listening() as taken,
        pytest.raises(EndpointError, match=r"(?i)address already in use|address in use"),
        serving(segment, taken.address, program),
    ):
        pass
    assert not folder(segment).exists()


class Listening:
    """A server that belongs to another program."""

    def __enter__(self) -> Listening:

        self._socket = socket.create_server(("127.0.0.1", 0))
        self.address = Address("127.0.0.1", self._socket.getsockname()[1])
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()


EVERYBODY = {"roles": ["read", "write"]}
OPEN: dict[str, Any] = {"listen": "127.0.0.1:1883", "account": [EVERYBODY]}


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"broker": "mosquitto"}, r'mqtt\.broker: "mosquitto" is not on this machine; install'),
        (
            {"listen": "0.0.0.0:1883", "insecure": True},
            r"mqtt\.listen: other hosts can reach 0\.0\.0\.0:1883, .*needs mosquitto",
        ),
        (
            {"listen": "cell.lan:1883", "insecure": True},
            r"mqtt\.listen: other hosts can reach cell\.lan:1883, .*needs mosquitto",
        ),
        ({"tls": {"certificate": "c.pem", "key": "k.pem"}}, r"mqtt\.tls: .*needs mosquitto"),
        ({"password_file": "accounts"}, r"mqtt\.password_file: .*needs mosquitto"),
        ({"account": []}, r"mqtt\.account: .*needs mosquitto"),
        ({"account": [{"roles": ["read"]}]}, r"mqtt\.account: .*needs mosquitto"),
        ({"account": [{"roles": ["write"]}]}, r"mqtt\.account: .*needs mosquitto"),
        ({"account": [{"roles": ["read", "write"], "name": "anna"}]}, r"mqtt\.account: .*needs mosquitto"),
    ],
)
def test_settings_that_need_mosquitto_are_refused_without_it(
    settings: dict[str, Any], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mqtt = msgspec.convert(OPEN | settings, Mqtt)
    monkeypatch.setenv("SHMIO_MOSQUITTO", sys.executable)  # stands for any program
    assert choose_broker(mqtt) == sys.executable
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    with pytest.raises(ConfigError, match=told):
        choose_broker(mqtt)


def test_amqtt_is_used_if_it_is_installed_and_mosquitto_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    mqtt = msgspec.convert(OPEN, Mqtt)
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    assert choose_broker(mqtt) is None
    assert choose_broker(msgspec.structs.replace(mqtt, listen="[::1]:1883")) is None
    monkeypatch.setitem(sys.modules, "amqtt", None)  # as if not installed
    with pytest.raises(ConfigError, match=r"apt install mosquitto.*pip install 'shmio\[broker\]'"):
        choose_broker(mqtt)


def test_the_broker_process_refuses_them_too(
    segment: Segment, address: Address, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHMIO_MOSQUITTO", "")
    with pytest.raises(ConfigError, match="needs mosquitto"), serving(segment, address, account=[]):
        pass
    assert not folder(segment).exists()


def test_the_configuration_of_mosquitto(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOGNAME", "nobody")  # as some ways to become root leave it
    tls = MqttTls(ca="/c/ca.pem", certificate="/c/c.pem", key="/c/k.pem")
    text = mosquitto.configuration(Mqtt(listen="[::1]:1883", password_file="/c/a", tls=tls), tmp_path, anonymous=False)
    lines = text.splitlines()
    own, others = lines.index(f"listener 0 {tmp_path / 's'}"), lines.index("listener 1883 ::1")
    assert lines[own + 1 :] == [
        "allow_anonymous false",
        f"password_file {tmp_path / 'bridge'}",
        f"acl_file {tmp_path / 'bridge-rights'}",
    ]
    assert lines[others + 1 : own] == [
        "allow_anonymous false",
        f"acl_file {tmp_path / 'rights'}",
        f"password_file {tmp_path / 'accounts'}",
        "certfile /c/c.pem",
        "keyfile /c/k.pem",
        "cafile /c/ca.pem",
        "require_certificate true",
    ]
    assert "persistence false" in lines[:others]
    assert "user root" in lines[:others]
