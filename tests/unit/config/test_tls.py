"""The endpoint's PEM files: errors name the unusable file and the reason."""

from __future__ import annotations

from pathlib import Path

import pytest
import trustme
from cryptography.hazmat.primitives import serialization as pem

from shmio.config import Tls
from shmio.config.tls import read_tls
from shmio.errors import ConfigError


@pytest.fixture(scope="module")
def authority() -> trustme.CA:
    return trustme.CA()


@pytest.fixture
def files(tmp_path: Path, authority: trustme.CA) -> Path:
    """A folder with usable and unusable files."""
    server, other = authority.issue_cert("localhost"), authority.issue_cert("localhost")
    server.cert_chain_pems[0].write_to_path(tmp_path / "certificate")
    server.private_key_pem.write_to_path(tmp_path / "key")
    authority.cert_pem.write_to_path(tmp_path / "ca")
    other.private_key_pem.write_to_path(tmp_path / "other key")
    (tmp_path / "garbage").write_bytes(bytes(range(256)))
    key = pem.load_pem_private_key(server.private_key_pem.bytes(), None)
    locked = key.private_bytes(pem.Encoding.PEM, pem.PrivateFormat.PKCS8, pem.BestAvailableEncryption(b"open sesame"))
    (tmp_path / "encrypted").write_bytes(locked)
    (tmp_path / "folder").mkdir()
    return tmp_path


def tls(files: Path, certificate: str, key: str, client_ca: str | None) -> Tls:
    return Tls(
        certificate=str(files / certificate), key=str(files / key), client_ca=client_ca and str(files / client_ca)
    )


@pytest.mark.parametrize("client_ca", [None, "ca"])
def test_usable_files_are_read(files: Path, client_ca: str | None) -> None:
    read = read_tls(tls(files, "certificate", "key", client_ca))
    assert read.certificate == (files / "certificate").read_bytes()
    assert read.key == (files / "key").read_bytes()
    assert read.client_ca == (client_ca and (files / client_ca).read_bytes())


@pytest.mark.parametrize(
    ("certificate", "key", "client_ca", "message"),
    [
        ("none", "key", None, r"certificate: .*none: No such file"),
        ("folder", "key", None, r"certificate: .*folder: Is a directory"),
        ("garbage", "key", None, r"certificate: .*garbage: the file has no usable PEM certificate"),
        ("key", "certificate", None, r"certificate: .*key: the file has no usable PEM certificate"),
        ("certificate", "none", None, r"key: .*none: No such file"),
        ("certificate", "garbage", None, r"key: .*garbage: the file has no usable PEM key"),
        ("certificate", "certificate", None, r"key: .*certificate: the file has no usable PEM key"),
        ("certificate", "other key", None, r"key: .*other key: this key does not belong to grpc\.tls\.certificate"),
        ("certificate", "encrypted", None, r"key: .*encrypted: the key needs a passphrase"),
        ("certificate", "key", "garbage", r"client_ca: .*garbage: the file has no usable PEM certificate"),
        ("certificate", "key", "key", r"client_ca: .*key: the file has no usable PEM certificate"),
        ("certificate", "key", "none", r"client_ca: .*none: No such file"),
    ],
)
def test_unusable_file_is_named(files: Path, certificate: str, key: str, client_ca: str | None, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"^grpc\.tls\.{message}"):
        read_tls(tls(files, certificate, key, client_ca))
