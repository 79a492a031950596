"""Read and test the gRPC endpoint's PEM files: gRPC reports a bad file like a busy port."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import NamedTuple

from shmio.config.model import Tls
from shmio.config.pem import detail, load_authority, load_pair
from shmio.errors import ConfigError


class TlsFiles(NamedTuple):
    """The contents of the PEM files; ``client_ca`` is None when clients need no certificate."""

    certificate: bytes
    key: bytes
    client_ca: bytes | None


def read_tls(tls: Tls) -> TlsFiles:
    """Read and test the PEM files; ConfigError names the key of an unusable file."""
    found = TlsFiles(
        key=_read("key", tls.key),
        certificate=_read("certificate", tls.certificate),
        client_ca=_read("client_ca", tls.client_ca) if tls.client_ca else None,
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    load_authority(context, tls.certificate, "grpc.tls.certificate")
    if tls.client_ca:
        load_authority(context, tls.client_ca, "grpc.tls.client_ca")
    try:
        load_pair(context, tls.certificate, tls.key, "grpc.tls")
    except ssl.SSLError as error:
        other = error.reason == "KEY_VALUES_MISMATCH"
        why = "not the key of grpc.tls.certificate" if other else f"no usable PEM private key{detail(error)}"
        raise ConfigError(f"grpc.tls.key: {tls.key}: {why}") from None
    return found


def _read(key: str, name: str) -> bytes:
    try:
        return Path(name).read_bytes()
    except OSError as error:
        raise ConfigError(f"grpc.tls.{key}: {name}: {error.strerror}") from None
