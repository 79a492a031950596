"""Certificates, the trust list, and users, with a server that demands them."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import NameOID

from shmio.connectors.opcua import trust
from shmio.connectors.opcua.connector import OpcUaConnector
from shmio.connectors.opcua.options import OpcUaOptions
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.addresses.siemens import NAMESPACE
from shmio.layout.tags import place_tags
from shmio.model.statuses import GOOD
from tests.unit.connectors.opcua.device import Device
from tests.unit.connectors.opcua.harness import Source, connected, until
from tests.unit.connectors.opcua.node_server import NodeServer
from tests.unit.endpoints.opcua.certificates import self_signed

TAGS = {"level": "REAL"}
DAY = datetime.timedelta(days=1)


class Authority:
    """An authority that signs certificates; or, without one, a maker of self-signed ones."""

    def __init__(self, folder: Path, name: str = "authority") -> None:
        self._folder = folder
        self.key = rsa.generate_private_key(65537, 2048)
        self.name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        self.file = self._write(name, self._builder(self.name, self.key).add_extension(
            x509.BasicConstraints(True, None), critical=True
        ).sign(self.key, hashes.SHA256()))  # fmt: skip

    def _builder(self, name: x509.Name, key: rsa.RSAPrivateKey, days: tuple[int, int] = (-1, 30)) -> Any:
        now = datetime.datetime.now(datetime.UTC)
        return (
            x509.CertificateBuilder().subject_name(name).issuer_name(self.name).public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now + days[0] * DAY).not_valid_after(now + days[1] * DAY)
        )  # fmt: skip

    def _write(self, name: str, certificate: x509.Certificate) -> Path:
        file = self._folder / f"{name}.der"
        file.write_bytes(certificate.public_bytes(serialization.Encoding.DER))
        return file

    def issue(
        self, name: str, uri: str = "urn:test:client", host: str = "localhost", days: tuple[int, int] = (-1, 30)
    ) -> tuple[Path, Path]:
        """Return the files of a certificate and of its key."""
        key = rsa.generate_private_key(65537, 2048)
        names = [x509.UniformResourceIdentifier(uri), x509.DNSName(host)] if uri else [x509.DNSName(host)]
        usage = x509.KeyUsage(True, True, True, True, False, False, False, False, False)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        made = (
            self._builder(subject, key, days).add_extension(x509.SubjectAlternativeName(names), critical=False)
            .add_extension(usage, critical=True).sign(self.key, hashes.SHA256())
        )  # fmt: skip
        private = self._folder / f"{name}-key.pem"
        private.write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        return self._write(name, made), private


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def secured(authority: Authority) -> Iterator[tuple[Device, Path]]:
    certificate, key = authority.issue("server", "urn:test:server")
    with Device(certificate, key) as device:
        device.ask("add", "level", "Float", 2.5)
        yield device, certificate


@pytest.fixture(scope="module")
def client(authority: Authority) -> tuple[Path, Path]:
    """The files of the client's certificate and of its key."""
    return authority.issue("client")


@pytest.fixture
def keys(tmp_path: Path, client: tuple[Path, Path]) -> dict[str, Any]:
    certificate, key = client
    (tmp_path / "trusted").mkdir()
    password = tmp_path / "password"
    password.write_text("secret password\n")
    password.chmod(0o600)
    return {
        "security": "SignAndEncrypt", "certificate": str(certificate), "key": str(key), "username": "operator",
        "password_file": str(password), "trusted": str(tmp_path / "trusted"),
    }  # fmt: skip


def test_an_unknown_server_is_rejected_until_somebody_trusts_it(
    secured: tuple[Device, Path], keys: dict[str, Any], tmp_path: Path
) -> None:
    device, certificate = secured
    with (
        pytest.raises(ConnectorError, match=r"not trusted \(server, SHA-1 [0-9A-F]{40}\).*mv '") as raised,
        connected(device.url, TAGS, **keys),
    ):
        pass
    (stored,) = (tmp_path / "rejected").iterdir()
    assert str(stored) in str(raised.value)
    assert stored.read_bytes() == certificate.read_bytes()
    stored.rename(tmp_path / "trusted" / stored.name)
    with connected(device.url, TAGS, **keys) as source:
        assert (source.value("level"), source.status("level").code) == (2.5, GOOD)
        assert source.write("level", 3.5) == ""
        assert "SignAndEncrypt, Basic256Sha256" in source.connector.describe()
        assert source.write("level", 2.5) == ""


def test_policy_and_mode(secured: tuple[Device, Path], keys: dict[str, Any], tmp_path: Path) -> None:
    device, certificate = secured
    (tmp_path / "trusted/server.der").write_bytes(certificate.read_bytes())
    other = keys | {"security": "Sign", "policy": "Aes256Sha256RsaPss"}
    with connected(device.url, TAGS, **other) as source:
        assert source.value("level") == 2.5
    with (
        pytest.raises(ConnectorError, match="offers: Aes256_Sha256_RsaPss with Sign, Basic256Sha256 with SignAndEnc"),
        connected(device.url, TAGS, **keys | {"policy": "Aes128Sha256RsaOaep"}),
    ):
        pass


def test_a_server_of_a_trusted_authority(
    secured: tuple[Device, Path], keys: dict[str, Any], tmp_path: Path, authority: Authority
) -> None:
    """Its certificate must be for the host in the URL."""
    device, _ = secured
    (tmp_path / "trusted/authority.der").write_bytes(authority.file.read_bytes())
    url = f"opc.tcp://localhost:{device.address.port}"
    with connected(url, TAGS, **keys) as source:
        assert source.value("level") == 2.5
    with pytest.raises(ConnectorError, match=r"not for 127\.0\.0\.1"), connected(device.url, TAGS, **keys):
        pass


def test_a_server_that_rejects_the_clients_certificate(keys: dict[str, Any], tmp_path: Path) -> None:
    """The error says whom to ask; once the server trusts the certificate, the same source is good."""
    folder = tmp_path / "node"
    folder.mkdir()
    level = {"id": "level", "type": "Float", "value": 2.5, "writable": False}
    anonymous = {name: value for name, value in keys.items() if name not in ("username", "password_file")}
    tags = {"level": {"type": "REAL", "address": f"nsu={NAMESPACE};s=level"}}
    with NodeServer(folder, [level], secured=True) as server:
        shown = self_signed(tmp_path, "urn:test:client")
        source = Source(server.url, tags, **anonymous | {"certificate": str(shown[0]), "key": str(shown[1])})
        with pytest.raises(ConnectorError, match="not trusted"):
            source.connector.connect()
        (stored,) = (tmp_path / "rejected").iterdir()
        stored.rename(tmp_path / "trusted" / stored.name)
        with pytest.raises(ConnectorError, match="client's certificate") as raised:
            source.connector.connect()
        assert str(shown[0]) in str(raised.value)
        (rejected,) = (folder / "pki/rejected").iterdir()
        rejected.rename(folder / "pki/trusted/certs" / rejected.name)

        def trusted() -> bool:
            with suppress(ConnectorError):
                source.connector.connect()
                return True
            return False

        until(trusted, "the server has noticed the file")
        assert source.value("level") == 2.5
        source.connector.close()


def test_users(secured: tuple[Device, Path], keys: dict[str, Any], tmp_path: Path) -> None:
    device, certificate = secured
    (tmp_path / "trusted/server.der").write_bytes(certificate.read_bytes())
    with (
        pytest.raises(ConnectorError, match="refuses the user 'nobody'"),
        connected(device.url, TAGS, **keys | {"username": "nobody"}),
    ):
        pass
    anonymous = {name: value for name, value in keys.items() if name not in ("username", "password_file")}
    with (
        pytest.raises(ConnectorError, match="set username and password_file"),
        connected(device.url, TAGS, **anonymous),
    ):
        pass


@pytest.fixture
def user(keys: dict[str, Any], authority: Authority) -> dict[str, Any]:
    """Keys of a user with a certificate."""
    certificate, key = authority.issue("user", uri="")
    key.chmod(0o600)
    others = {name: value for name, value in keys.items() if name not in ("username", "password_file")}
    return others | {"user_certificate": str(certificate), "user_key": str(key)}


@pytest.mark.parametrize("channel", [{}, {"security": "Sign", "policy": "Aes256Sha256RsaPss"}])
def test_a_user_with_a_certificate(
    secured: tuple[Device, Path], user: dict[str, Any], tmp_path: Path, channel: dict[str, str]
) -> None:
    device, certificate = secured
    (tmp_path / "trusted/server.der").write_bytes(certificate.read_bytes())
    with (
        pytest.raises(ConnectorError, match=r"refuses the user's certificate .*user\.der"),
        connected(device.url, TAGS, **user | channel),
    ):
        pass
    device.ask("trust", Path(user["user_certificate"]).read_bytes().hex())
    with connected(device.url, TAGS, **user | channel) as source:
        assert (source.value("level"), source.write("level", 3.5), source.write("level", 2.5)) == (2.5, "", "")


def test_a_user_whose_certificate_has_expired(
    secured: tuple[Device, Path], user: dict[str, Any], tmp_path: Path, authority: Authority
) -> None:
    device, certificate = secured
    (tmp_path / "trusted/server.der").write_bytes(certificate.read_bytes())
    expired, key = authority.issue("past", uri="", days=(-5, -1))
    key.chmod(0o600)
    given = user | {"user_certificate": str(expired), "user_key": str(key)}
    with pytest.raises(ConnectorError, match=r"past\.der has expired"), connected(device.url, TAGS, **given):
        pass


def test_a_user_with_a_certificate_at_node_opcua(user: dict[str, Any], tmp_path: Path) -> None:
    """The server admits a user whose certificate it trusts, and refuses another one."""
    folder = tmp_path / "node"
    client, person, other = (self_signed(tmp_path, f"urn:test:{name}", name) for name in ("client", "person", "other"))
    for shown, place in ((client, folder / "pki"), (person, folder / "users")):
        (place / "trusted/certs").mkdir(parents=True)
        (place / "trusted/certs/known.pem").write_bytes(shown[0].read_bytes())
    level = {"id": "level", "type": "Float", "value": 2.5, "writable": False}
    tags = {"level": {"type": "REAL", "address": f"nsu={NAMESPACE};s=level"}}

    def source(files: tuple[Path, Path]) -> Source:
        files[1].chmod(0o600)
        given = user | {"certificate": str(client[0]), "key": str(client[1]), "timeout": 5000}
        return Source(server.url, tags, **given | {"user_certificate": str(files[0]), "user_key": str(files[1])})

    with NodeServer(folder, [level], secured=True) as server:
        with pytest.raises(ConnectorError, match="not trusted"):
            source(other).connector.connect()
        (stored,) = (tmp_path / "rejected").iterdir()
        stored.rename(tmp_path / "trusted" / stored.name)
        with pytest.raises(ConnectorError, match=r"refuses the user's certificate .*other\.pem"):
            source(other).connector.connect()
        admitted = source(person)
        admitted.connector.connect()
        assert admitted.value("level") == 2.5
        admitted.connector.close()


def test_certificates_of_others_do_not_count(authority: Authority, tmp_path: Path) -> None:
    trusted = tmp_path / "trusted"
    trusted.mkdir()
    (trusted / "authority.der").write_bytes(authority.file.read_bytes())
    (trusted / "broken.der").write_bytes(b"\x30\x82\xff")
    stranger = Authority(tmp_path, "authority")
    file, _ = stranger.issue("stranger")
    with pytest.raises(ConnectorError, match="not trusted"):
        trust.check_server(file.read_bytes(), trusted, "localhost")
    file, _ = authority.issue("expired", days=(-5, -1))
    with pytest.raises(ConnectorError, match="has expired"):
        trust.check_server(file.read_bytes(), trusted, "localhost")
    file, _ = authority.issue("early", days=(1, 5))
    with pytest.raises(ConnectorError, match="valid only from"):
        trust.check_server(file.read_bytes(), trusted, "localhost")
    leaf, _ = authority.issue("leaf")
    (trusted / "leaf.der").write_bytes(leaf.read_bytes())
    trust.check_server(leaf.read_bytes() + file.read_bytes(), trusted, "elsewhere")
    for garbage in (b"", b"\x30", b"\x30\x82\0\1\0", bytes(100)):
        with pytest.raises(ConnectorError, match="no valid certificate"):
            trust.check_server(garbage, trusted, "localhost")


def test_the_folder_of_rejected_certificates_is_bounded(
    tmp_path: Path, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trust, "MAX_REJECTED", 1)
    (tmp_path / "trusted").mkdir()
    first, second = (authority.issue(name)[0] for name in ("first", "second"))
    for file in (first, first, second):
        with pytest.raises(ConnectorError, match="not trusted"):
            trust.check_server(file.read_bytes(), tmp_path / "trusted", "localhost")
    assert len(list((tmp_path / "rejected").iterdir())) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"key": "certificate"}, "key: .*no usable private key"),
        ({"certificate": "key"}, "certificate: .*no usable certificate"),
        ({"certificate": "trusted"}, "certificate: .*directory"),
        ({"password_file": "certificate"}, "password_file: "),
        ({"user_certificate": "key", "user_key": "user_key"}, "user_certificate: .*no usable certificate"),
        ({"user_certificate": "certificate", "user_key": "user_key"}, "user_key: .*does not belong to"),
        ({"user_certificate": "certificate", "user_key": "key"}, "user_key: .*mode is 0644; run chmod 600"),
        ({"user_certificate": "certificate", "user_key": "password_file"}, "user_key: .*no usable private key"),
        ({"user_certificate": "certificate", "user_key": "trusted"}, "user_key: .*not a regular file"),
    ],
)
def test_wrong_files_are_named(keys: dict[str, Any], user: dict[str, Any], change: dict[str, str], words: str) -> None:
    changed = keys | {key: (keys | user)[other] for key, other in change.items()}
    if "user_key" in change:
        del changed["username"], changed["password_file"]
    with pytest.raises(ConfigError, match=words):
        Source("opc.tcp://127.0.0.1:4840", TAGS, **changed)


def test_the_certificate_has_an_application_uri_and_fits_the_key(keys: dict[str, Any], authority: Authority) -> None:
    certificate, key = authority.issue("without", uri="")
    with pytest.raises(ConfigError, match="no application URI"):
        Source("opc.tcp://h", TAGS, **keys | {"certificate": str(certificate), "key": str(key)})
    with pytest.raises(ConfigError, match="this key does not belong to"):
        Source("opc.tcp://h", TAGS, **keys | {"key": str(key)})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"url": "http://h"}, "url: expected opc.tcp"),
        ({"url": "opc.tcp://"}, "url: expected"),
        ({"url": "opc.tcp://h:99999"}, "url: expected"),
        ({"url": "opc.tcp://me:word@h"}, "without a user"),
        ({"security": "Sign"}, "certificate: this key is needed"),
        ({"trusted": "x"}, "trusted: this key has no effect"),
        ({"username": "x"}, "both username and password_file"),
        ({"username": "x", "password_file": "y"}, "without encryption"),
        ({"user_key": "x"}, "both user_certificate and user_key"),
        ({"user_key": "x", "user_certificate": "y"}, "only with security"),
        ({"user_key": "x", "user_certificate": "y", "username": "z", "password_file": "w"}, "either a certificate or"),
    ],
)
def test_keys_that_contradict(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        OpcUaOptions(**{"url": "opc.tcp://plc"} | given)


def test_layouts_without_addresses_and_optimized_ones() -> None:
    layout = place_tags("t", {"a": "INT"}).with_statuses()
    with pytest.raises(ConfigError, match="layout: a: the key `address` is missing"):
        OpcUaConnector(OpcUaOptions(url="opc.tcp://h"), layout)
