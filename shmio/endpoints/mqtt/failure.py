"""Why there is no connection, in words that tell what to look at."""

from __future__ import annotations

import socket
import ssl
from typing import TYPE_CHECKING, Final

from paho.mqtt.reasoncodes import ReasonCode

if TYPE_CHECKING:
    from shmio.endpoints.mqtt.target import Dialling, Target

# MQTT 5.0, section 2.4; paho gives those of 3.1.1 the same numbers.
_WHO: Final = frozenset({0x86, 0x87})
_BUSY: Final = frozenset({0x88, 0x89, 0x97, 0x9F})
_TAKEN_OVER: Final = 0x8E


def refusal(code: ReasonCode, dialling: Dialling) -> str:
    """What a broker's code means here."""
    if code.value in _WHO:
        return f"it does not let us in ({code}): check mqtt.username, mqtt.password_file and the broker's own accounts"
    if code.value in _BUSY:
        return f"it takes no more at present ({code})"
    if code.value == _TAKEN_OVER:
        return f"another client has connected as {dialling.client_id}: give one of them another mqtt.client_id"
    return f"it refuses: {code}"


def why(error: Exception, target: Target) -> str:
    """Why no connection could be made."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not to be trusted ({error.verify_message}): check mqtt.tls.ca, and the host's name"
    if isinstance(error, ssl.SSLError):
        return f"no TLS with it ({error.reason or 'it ended the connection'}): check mqtt.tls, and the port"
    if isinstance(error, socket.gaierror):
        return f"no host of this name is known ({error.strerror})"
    if isinstance(error, TimeoutError):
        return "it does not answer"
    if isinstance(error, ConnectionRefusedError | FileNotFoundError):
        if target.transport == "unix":
            return "it does not run at present; shmio-supervisor logs broker says why"
        return "nothing listens there"
    if isinstance(error, ConnectionError):
        return "it closed the connection"
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
