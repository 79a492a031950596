"""The PEM files of ``[mqtt.tls]``, tried by TLS itself."""

from __future__ import annotations

import ssl

from shmio.config.mqttmodel import MqttTls
from shmio.errors import ConfigError


def client_context(tls: MqttTls) -> ssl.SSLContext:
    """For a broker elsewhere: its certificate must be one of ``ca``, or of the host's own authorities. ConfigError."""
    context = ssl.create_default_context()
    if tls.ca is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        _trust(context, tls.ca)
    if tls.certificate is not None:
        _show(context, tls)
    context.sslsocket_class = _Socket
    return context


class _Socket(ssl.SSLSocket):
    """Is closed when no TLS comes about; who makes it then has no other way to."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except OSError:
            self.close()
            raise


def server_context(tls: MqttTls) -> ssl.SSLContext:
    """For our own broker; with ``ca`` clients must show a certificate of it. ConfigError."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    _show(context, tls)
    if tls.ca is not None:
        _trust(context, tls.ca)
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def _trust(context: ssl.SSLContext, name: str) -> None:
    try:
        context.load_verify_locations(name)
    except ssl.SSLError as error:
        raise ConfigError(f"mqtt.tls.ca: {name}: no usable PEM certificate{_detail(error)}") from None
    except OSError as error:
        raise ConfigError(f"mqtt.tls.ca: {name}: {error.strerror}") from None


def _show(context: ssl.SSLContext, tls: MqttTls) -> None:
    certificate, key = str(tls.certificate), str(tls.key)
    for field, name in (("certificate", certificate), ("key", key)):
        try:
            with open(name, "rb"):  # noqa: PTH123  to tell which of both it is
                pass
        except OSError as error:
            raise ConfigError(f"mqtt.tls.{field}: {name}: {error.strerror}") from None
    try:
        context.load_cert_chain(certificate, key, password=_refuse_to_ask)
    except _EncryptedError:
        raise ConfigError(f"mqtt.tls.key: {key}: needs a passphrase; give one that needs none") from None
    except ssl.SSLError as error:
        raise ConfigError(f"mqtt.tls: {certificate} and {key} are no certificate and its key{_detail(error)}") from None


def _detail(error: ssl.SSLError) -> str:
    return f" ({error.reason})" if error.reason else ""


class _EncryptedError(Exception):
    pass


def _refuse_to_ask() -> str:
    raise _EncryptedError
