"""TLS contexts from the PEM files of ``[mqtt.tls]``."""

from __future__ import annotations

import ssl

from shmio.config.model import MqttTls
from shmio.config.pem import detail, load_authority, load_pair
from shmio.errors import ConfigError


def client_context(tls: MqttTls) -> ssl.SSLContext:
    """Return the TLS context for an external broker; ConfigError.

    ``ca`` must have issued the broker's certificate, or one of the host's authorities if there is
    no ``ca``.
    """
    context = ssl.create_default_context()
    if tls.ca is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        load_authority(context, tls.ca, "mqtt.tls.ca")
    if tls.certificate is not None:
        _show(context, tls)
    context.sslsocket_class = _Socket
    return context


class _Socket(ssl.SSLSocket):
    """Closes itself when the TLS handshake fails; its creator could not close it then."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except OSError:
            self.close()
            raise


def server_context(tls: MqttTls) -> ssl.SSLContext:
    """Return the TLS context of shmio's own broker; ConfigError.

    With ``ca``, clients must present a certificate issued by it.
    """
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
        raise ConfigError(
            f"mqtt.tls: {certificate} and {key} are not a certificate and its key{detail(error)}"
        ) from None
