"""The PEM files of ``[mqtt.tls]``, tried by TLS itself."""

from __future__ import annotations

import ssl

from shmio.config.mqtt.model import MqttTls
from shmio.config.pem import detail, load_authority, load_pair
from shmio.errors import ConfigError


def client_context(tls: MqttTls) -> ssl.SSLContext:
    """For a broker elsewhere: its certificate must be one of ``ca``, or of the host's own authorities. ConfigError."""
    context = ssl.create_default_context()
    if tls.ca is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        load_authority(context, tls.ca, "mqtt.tls.ca")
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
        load_authority(context, tls.ca, "mqtt.tls.ca")
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def _show(context: ssl.SSLContext, tls: MqttTls) -> None:
    certificate, key = str(tls.certificate), str(tls.key)
    for field, name in (("certificate", certificate), ("key", key)):
        try:
            with open(name, "rb"):  # noqa: PTH123  to tell which of both it is
                pass
        except OSError as error:
            raise ConfigError(f"mqtt.tls.{field}: {name}: {error.strerror}") from None
    try:
        load_pair(context, certificate, key, "mqtt.tls")
    except ssl.SSLError as error:
        raise ConfigError(f"mqtt.tls: {certificate} and {key} are no certificate and its key{detail(error)}") from None
