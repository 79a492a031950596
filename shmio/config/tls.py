"""The endpoint's PEM files, tried by TLS itself: gRPC does not tell a bad one from a busy port."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import NamedTuple

from shmio.config.model import Tls
from shmio.errors import ConfigError


class TlsFiles(NamedTuple):
    """What the files hold; ``client_ca`` is None when clients need no certificate."""

    certificate: bytes
    key: bytes
    client_ca: bytes | None


def read_tls(tls: Tls) -> TlsFiles:
    """Read and try them; ConfigError names the key of the file that will not do."""
    found = TlsFiles(
        key=_read("key", tls.key),
        certificate=_read("certificate", tls.certificate),
        client_ca=_read("client_ca", tls.client_ca) if tls.client_ca else None,
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _try_certificates("certificate", tls.certificate, context)
    if tls.client_ca:
        _try_certificates("client_ca", tls.client_ca, context)
    try:
        context.load_cert_chain(tls.certificate, tls.key, password=_refuse_to_ask)
    except _EncryptedError:
        raise ConfigError(f"grpc.tls.key: {tls.key}: needs a passphrase; give one that needs none") from None
    except ssl.SSLError as error:
        other = error.reason == "KEY_VALUES_MISMATCH"
        why = "not the key of grpc.tls.certificate" if other else f"no usable PEM private key{_detail(error)}"
        raise ConfigError(f"grpc.tls.key: {tls.key}: {why}") from None
    return found


def _read(key: str, name: str) -> bytes:
    try:
        return Path(name).read_bytes()
    except OSError as error:
        raise ConfigError(f"grpc.tls.{key}: {name}: {error.strerror}") from None


def _try_certificates(key: str, name: str, context: ssl.SSLContext) -> None:
    try:
        context.load_verify_locations(name)
    except ssl.SSLError as error:
        raise ConfigError(f"grpc.tls.{key}: {name}: no usable PEM certificate{_detail(error)}") from None


def _detail(error: ssl.SSLError) -> str:
    return f" ({error.reason})" if error.reason else ""


class _EncryptedError(Exception):
    pass


def _refuse_to_ask() -> str:
    raise _EncryptedError
