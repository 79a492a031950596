"""Reads and tests the PEM files that sections for TLS name, and makes TLS contexts from them."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import NamedTuple

from shmio.config.model import MqttTls, Tls
from shmio.errors import ConfigError


class TlsFiles(NamedTuple):
    """The contents of the PEM files; ``client_ca`` is None if clients need no certificate."""

    certificate: bytes
    key: bytes
    client_ca: bytes | None


def read_tls(tls: Tls) -> TlsFiles:
    """Read and test the gRPC endpoint's PEM files, because gRPC would report a bad file as a busy port.

    Raises:
        ConfigError: A file cannot be used; the message names its key.

    """
    found = TlsFiles(
        key=_read("key", tls.key),
        certificate=_read("certificate", tls.certificate),
        client_ca=_read("client_ca", tls.client_ca) if tls.client_ca else None,
    )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _load_authority(context, tls.certificate, "grpc.tls.certificate")
    if tls.client_ca:
        _load_authority(context, tls.client_ca, "grpc.tls.client_ca")
    try:
        _load_pair(context, tls.certificate, tls.key, "grpc.tls.key")
    except ssl.SSLError as error:
        other = error.reason == "KEY_VALUES_MISMATCH"
        why = (
            "this key does not belong to grpc.tls.certificate"
            if other
            else f"the file has no usable PEM key{_detail(error)}"
        )
        raise ConfigError(f"grpc.tls.key: {tls.key}: {why}") from None
    return found


def client_context(tls: MqttTls, where: str = "mqtt.tls.") -> ssl.SSLContext:
    """Return the TLS context for an external broker.

    The authority ``ca`` must have issued the broker's certificate, or ``ca`` is this certificate;
    without ``ca``, it comes from an authority that the host trusts. ``where`` is the beginning of the
    names of keys, for messages.

    Raises:
        ConfigError: A file cannot be used.

    """
    context = ssl.create_default_context()
    if tls.ca is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # the file may have the server's own certificate
        _load_authority(context, tls.ca, f"{where}ca")
    if tls.certificate is not None:
        _identify(context, tls, where)
    context.sslsocket_class = _Socket
    return context


def server_context(tls: MqttTls, where: str = "mqtt.tls.") -> ssl.SSLContext:
    """Return the TLS context of one of shmio's own servers.

    With ``ca``, clients must present a certificate that this authority has issued. ``where`` is the
    beginning of the names of keys, for messages.

    Raises:
        ConfigError: A file cannot be used.

    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _identify(context, tls, where)
    if tls.ca is not None:
        _load_authority(context, tls.ca, f"{where}ca")
        context.verify_mode = ssl.CERT_REQUIRED
    return context


class _Socket(ssl.SSLSocket):
    """A TLS socket that closes itself if the handshake fails, because its creator then has no reference to it."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except OSError:
            self.close()
            raise


def _identify(context: ssl.SSLContext, tls: MqttTls, where: str) -> None:
    """Load certificate and key, with which shmio identifies itself."""
    certificate, key = str(tls.certificate), str(tls.key)
    for field, name in (("certificate", certificate), ("key", key)):
        try:
            with open(name, "rb"):  # noqa: PTH123  to tell which of the two files is bad
                pass
        except OSError as error:
            raise ConfigError(f"{where}{field}: {name}: {error.strerror}") from None
    try:
        _load_pair(context, certificate, key, f"{where}key")
    except ssl.SSLError as error:
        what = f"{certificate} and {key} are not a certificate and its key{_detail(error)}"
        raise ConfigError(f"{where.rstrip('.') or 'certificate'}: {what}") from None


def _read(key: str, name: str) -> bytes:
    try:
        return Path(name).read_bytes()
    except OSError as error:
        raise ConfigError(f"grpc.tls.{key}: {name}: {error.strerror}") from None


def _load_pair(context: ssl.SSLContext, certificate: str, key: str, where: str) -> None:
    """Load a certificate and its key into a context.

    Raises:
        ssl.SSLError: A file cannot be used, or the key belongs to another certificate.
        ConfigError: The key needs a passphrase. The message begins with ``where``, the name of the
            configuration key.

    """
    try:
        context.load_cert_chain(certificate, key, password=_refuse_to_ask)
    except _EncryptedError:
        raise ConfigError(f"{where}: {key}: the key needs a passphrase; use a key without one") from None


def _load_authority(context: ssl.SSLContext, name: str, key: str) -> None:
    """Make a context trust the authorities in a file.

    Raises:
        ConfigError: The file has no usable certificate. The message begins with ``key``.

    """
    try:
        context.load_verify_locations(name)
    except ssl.SSLError as error:
        raise ConfigError(f"{key}: {name}: the file has no usable PEM certificate{_detail(error)}") from None
    except OSError as error:
        raise ConfigError(f"{key}: {name}: {error.strerror}") from None


class _EncryptedError(Exception):
    pass


def _refuse_to_ask() -> str:
    raise _EncryptedError


def _detail(error: ssl.SSLError) -> str:
    """Return the TLS library's reason in brackets, to append to a message; "" if it gives none."""
    return f" ({error.reason})" if error.reason else ""
