"""Posts a notice to an HTTP server, as JSON."""

from __future__ import annotations

import http.client
import socket
import ssl
import threading
from contextlib import suppress
from typing import Final

from shmio.config import Alert, MqttTls
from shmio.config.alert import parse_webhook
from shmio.config.credentials import read_headers
from shmio.config.tls import client_context
from shmio.endpoints.alerts.notice import Notice
from shmio.endpoints.alerts.sender import DeliveryError
from shmio.errors import ConfigError
from shmio.version import __version__

_AGAIN: Final = frozenset({408, 425, 429})
"""Statuses below 500 after which a later attempt may succeed (RFC 9110, 15.5; RFC 8470; RFC 6585)."""


class Webhook:
    """An action that posts notices to one URL, as JSON. It never follows a redirect."""

    once = False

    def __init__(self, alert: Alert) -> None:
        """Prepare to post the notices of an alert."""
        self._parts = parse_webhook(alert.webhook or "")
        self.text = f"webhook at {self._parts.hostname}"  # the path may be a secret
        self._alert = alert
        self._lock = threading.Lock()
        self._connection: http.client.HTTPConnection | None = None
        self._late = False
        self._stopping = False

    def stop(self) -> None:
        """Abort a request in progress."""
        self._stopping = True
        self._shut_down()

    def deliver(self, notice: Notice) -> None:
        """Post a notice, and check the status of the response.

        Raises:
            DeliveryError: The server cannot be reached, or does not accept the notice.

        """
        timeout_s = self._alert.webhook_timeout_s
        self._late = False
        timer = threading.Timer(timeout_s, self._time_out)  # a socket's own time-out starts again with each byte
        timer.daemon = True
        timer.start()
        try:
            self._post(notice)
        except ConfigError as error:  # a file has changed since the configuration was checked
            raise DeliveryError(str(error), again=True) from None
        except (OSError, http.client.HTTPException) as error:
            if self._late or isinstance(error, TimeoutError):
                raise DeliveryError(f"no answer within {timeout_s:g} s", again=True) from None
            raise DeliveryError(_why(error), again=True) from None
        finally:
            timer.cancel()
            with self._lock:
                connection, self._connection = self._connection, None
            if connection is not None:
                connection.close()

    def _post(self, notice: Notice) -> None:
        alert, parts = self._alert, self._parts
        headers = {"Content-Type": "application/json", "User-Agent": f"shmio/{__version__}"}
        if alert.webhook_header_file is not None:
            headers |= read_headers(alert.webhook_header_file, "webhook_header_file")
        host, timeout_s = str(parts.hostname), alert.webhook_timeout_s
        connection: http.client.HTTPConnection
        if parts.scheme == "https":
            context = client_context(MqttTls(ca=alert.webhook_ca), "webhook_")
            connection = http.client.HTTPSConnection(host, parts.port, timeout=timeout_s, context=context)
        else:
            connection = http.client.HTTPConnection(host, parts.port, timeout=timeout_s)
        connection.connect()
        with self._lock:
            self._connection = connection
        if self._late or self._stopping:
            raise TimeoutError
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        connection.request("POST", path, notice.json(), headers)
        with connection.getresponse() as response:
            status, reason = response.status, response.reason[:100]
        if self._late:  # to http.client, the end of the connection looks like the end of the headers
            raise TimeoutError
        if 300 <= status < 400:
            where = (response.getheader("Location") or "elsewhere")[:200]
            raise DeliveryError(
                f"the server answers {status}, which points to {where}, but redirects are not followed; write the "
                "final URL in webhook"
            )
        if not 200 <= status < 300:
            raise DeliveryError(
                f"the server answers {status} {reason}".rstrip(), again=status >= 500 or status in _AGAIN
            )

    def _time_out(self) -> None:
        self._late = True
        self._shut_down()

    def _shut_down(self) -> None:
        with self._lock:
            made = None if self._connection is None else self._connection.sock
            if made is not None:
                with suppress(OSError):
                    socket.socket.shutdown(made, socket.SHUT_RDWR)  # only its own thread may call shutdown() of TLS


def _why(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({error.verify_message}); check webhook_ca, and the host's name"
    if isinstance(error, ssl.SSLError):
        return f"the TLS handshake failed ({error.reason}); check https, and the port"
    if isinstance(error, socket.gaierror):
        return f"unknown host name ({error.strerror})"
    if isinstance(error, ConnectionRefusedError):
        return "nothing listens there"
    if isinstance(error, http.client.RemoteDisconnected | ConnectionError):
        return "the connection was lost"
    if isinstance(error, http.client.HTTPException):
        return f"this is not HTTP ({type(error).__name__})"
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
