"""The connection to a broker: logins, TLS, and brokers that break the protocol."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import trustme

from shmio.config import Address
from shmio.config.credentials import hashed
from shmio.connectors.mqtt.link import MAX_PACKET_BYTES
from shmio.errors import ConnectorError
from shmio.testing.mosquitto import Mosquitto, missing
from shmio.testing.ports import reserved_port
from tests.unit.connectors.mqtt.peer import connected

TAGS = {"a": ("INT", "a")}
CONNACK, CONNACK_3 = b"\x20\x03\0\0\0", b"\x20\x02\0\0"


@pytest.fixture
def make_broker(tmp_path: Path) -> Iterator[Callable[..., Address]]:
    if reason := missing():
        pytest.skip(reason)
    with contextlib.ExitStack() as stack:

        def make(*lines: str) -> Address:
            address = stack.enter_context(reserved_port())
            broker = Mosquitto(tmp_path, address, *lines)
            stack.callback(broker.stop)
            broker.start()
            return address

        yield make


def secret(folder: Path, text: str) -> str:
    file = folder / "password"
    file.write_text(text)
    file.chmod(0o600)
    return str(file)


def test_logins(make_broker: Callable[..., Address], tmp_path: Path) -> None:
    passwords = tmp_path / "accounts"
    passwords.write_text(f"anna:{hashed('right')}\n")
    address = make_broker("allow_anonymous false", f"password_file {passwords}")
    login = {"username": "anna", "password_file": secret(tmp_path, "right\n")}
    for version in ("5", "3.1.1"):
        with connected(address, TAGS, version=version, **login) as source:
            source.read()
        with (
            pytest.raises(ConnectorError, match="check username, password_file"),
            connected(address, TAGS, version=version),
        ):
            pass
    with connected(address, TAGS, **login) as source:  # the password is read again for each connection
        secret(tmp_path, "wrong")
        with pytest.raises(ConnectorError, match="check username"):
            source.connector.connect()
        secret(tmp_path, "")
        with pytest.raises(ConnectorError, match=r"password_file: .* is empty"):
            source.connector.connect()
        secret(tmp_path, "right")
        source.connector.connect()
        source.read()
    wrong = login | {"password_file": secret(tmp_path, "wrong")}
    with pytest.raises(ConnectorError, match="check username, password_file"), connected(address, TAGS, **wrong):
        pass


def test_tls(make_broker: Callable[..., Address], tmp_path: Path) -> None:
    authority, other = trustme.CA(), trustme.CA()
    server, client = authority.issue_cert("127.0.0.1"), authority.issue_cert("shmio")
    for name, made in (("server", server), ("client", client)):
        made.private_key_pem.write_to_path(tmp_path / f"{name}.key")
        made.cert_chain_pems[0].write_to_path(tmp_path / f"{name}.pem")
    authority.cert_pem.write_to_path(tmp_path / "ca.pem")
    other.cert_pem.write_to_path(tmp_path / "other.pem")
    files = {one: tmp_path / one for one in ("ca.pem", "server.pem", "server.key")}
    address = make_broker(
        "allow_anonymous true", f"cafile {files['ca.pem']}", f"certfile {files['server.pem']}",
        f"keyfile {files['server.key']}", "require_certificate true",
    )  # fmt: skip
    url, ca = f"mqtts://{address}", str(tmp_path / "ca.pem")
    own = {"certificate": str(tmp_path / "client.pem"), "key": str(tmp_path / "client.key")}
    with connected(address, TAGS, url=url, ca=ca, **own) as source:
        source.read()
        assert "TLS" in source.connector.describe()
    for options, words in (
        ({"url": url, "ca": str(tmp_path / "other.pem"), **own}, "certificate is not trusted"),
        ({"url": url, "ca": ca}, "check certificate and key|client certificate"),
        ({}, r"expect TLS there|was lost|cannot connect"),
    ):
        with pytest.raises(ConnectorError, match=words), connected(address, TAGS, **options):
            pass


def test_a_message_that_an_mqtt_5_broker_refuses_is_not_awaited(
    make_broker: Callable[..., Address], tmp_path: Path
) -> None:
    """The topic keeps its older value. This does not put the outcomes in doubt."""
    rules, passwords = tmp_path / "rules", tmp_path / "accounts"
    rules.write_text("topic readwrite a\ntopic read b\nuser owner\ntopic readwrite #\n")
    passwords.write_text(f"owner:{hashed('right')}\n")
    address = make_broker("allow_anonymous true", f"password_file {passwords}", f"acl_file {rules}")
    tags = {name: {"type": "INT", "address": name, "writable": True} for name in ("a", "b")}
    login = {"username": "owner", "password_file": secret(tmp_path, "right")}
    with connected(address, tags, retain=True, **login) as owner:
        assert owner.write(a=1, b=1) == ["", ""]
    with connected(address, tags, retain=True, version="5") as source:
        source.until(lambda: (source.value("a"), source.value("b")) == (1, 1))
        assert source.write(a=2, b=2) == ["", "the broker refuses the message: Not authorized"]
        source.read()
        assert (source.value("a"), source.value("b")) == (2, 1)


class Hostile:
    """A broker that answers CONNECT and each SUBSCRIBE correctly, and then sends the bytes of the test."""

    def __init__(self, first: bytes, then: bytes) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = Address(*self._listening.getsockname())
        self._first, self._then = first, then
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                with client, contextlib.suppress(OSError):
                    client.recv(4096)
                    client.sendall(self._first)
                    asked = client.recv(4096)
                    if asked:
                        client.sendall(b"\x90\x04" + asked[2:4] + b"\0\0" + self._then)
                    while client.recv(4096):
                        pass

    def close(self) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(20)
        assert not self._thread.is_alive()


@contextlib.contextmanager
def hostile(then: bytes = b"", first: bytes = CONNACK) -> Iterator[Address]:
    broker = Hostile(first, then)
    try:
        yield broker.address
    finally:
        broker.close()


def remaining(size: int) -> bytes:
    found = bytearray()
    while size > 127:
        found.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes([*found, size])


@pytest.mark.parametrize(
    ("then", "words"),
    [
        (b"\x30" + remaining(MAX_PACKET_BYTES + 1), "but at most"),
        (b"\x34\x07\0\x01a\0\x01\0x", "QoS 2"),
        (b"\x36\x07\0\x01a\0\x01\0x", "lost|protocol|read"),
        (b"\x30\x03\0\xffa", "lost|protocol|read"),
        (b"\x30\x04\0\x01a\x7f", "lost|protocol|read"),
        (b"\xe0\x02\x8e\0", "another client has connected"),
        (b"\xe0\x01\x8b", "ended the connection: Server shutting down"),
        (b"\xf0\x00", "lost|protocol|read"),
        (b"\xff\xff\xff\xff\xff\xff", "lost|protocol|read"),
        (b"\x62\x02\0\x09", "no answer|lost"),
        (b"", "no answer within 300 ms"),
    ],
)
def test_brokers_that_break_the_protocol(then: bytes, words: str) -> None:
    raises = pytest.raises(ConnectorError, match=words)
    with hostile(then) as address, raises, connected(address, TAGS, version="5", timeout=300) as source:
        source.until(lambda: False)


@pytest.mark.parametrize(
    ("first", "words"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "no answer|lost|login"),
        (b"\x20\x02\0\x05", "check username|lost|login|read"),
        (b"\x20\x03\0\x97\0", "refuses the connection: Quota exceeded"),
        (b"\xd0\x00", "no answer"),
        (b"", "no answer within 300 ms from .* to CONNECT"),
    ],
)
def test_brokers_that_do_not_accept(first: bytes, words: str) -> None:
    raises = pytest.raises(ConnectorError, match=words)
    with hostile(first=first) as address, raises, connected(address, TAGS, version="5", timeout=300):
        pass


def test_a_host_that_is_not_there() -> None:
    with reserved_port() as address, pytest.raises(ConnectorError, match="refused"), connected(address, TAGS):
        pass
    unknown = pytest.raises(ConnectorError, match=r"cannot connect to nowhere\.invalid")
    with unknown, connected(address, TAGS, url="mqtt://nowhere.invalid", insecure=True):
        pass
