"""Texts that say why there is no connection, and what to check."""

from __future__ import annotations

import logging
import socket
import ssl
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from paho.mqtt.reasoncodes import ReasonCode

if TYPE_CHECKING:
    from shmio.endpoints.mqtt.connection.target import ReconnectPolicy, Target

# MQTT 5.0, section 2.4; paho gives those of 3.1.1 the same numbers.
_WHO: Final = frozenset({0x86, 0x87})
_BUSY: Final = frozenset({0x88, 0x89, 0x97, 0x9F})
_TAKEN_OVER: Final = 0x8E

OFTEN: Final = 4
OFTEN_S: Final = 60.0
"""After so many lost connections in this time, the problem names a likely cause."""
REFUSED_S: Final = 10.0
"""How long a refusal stays the current problem though the broker accepts other messages."""

log = logging.getLogger("shmio.mqtt")


class ConnectionProblems:
    """The current problem of a connection; each is logged once."""

    def __init__(self) -> None:
        self.problem = ""
        """The current problem; empty: none."""
        self.refused = 0
        """Number of messages that the broker refused."""
        self._refused_s = 0.0
        self._subscription_problem = ""
        self._lost_s: deque[float] = deque(maxlen=OFTEN)

    def report(self, problem: str) -> None:
        """Set the current problem, and log it if it is new."""
        if problem != self.problem:
            log.warning("%s", problem)
        self.problem = problem

    def connection_lost(self, problem: str, client_id: str) -> str:
        """Count a lost connection, and return the text of the problem."""
        self._lost_s.append(time.monotonic())
        if len(self._lost_s) < OFTEN or self._lost_s[-1] - self._lost_s[0] > OFTEN_S:
            return problem
        return f"{problem}, again and again; does another client connect as {client_id} (mqtt.client_id)?"

    def clear(self) -> None:
        """Forget the problem: the connection is up."""
        self.problem = self._subscription_problem = ""

    def subscription_refused(self, problem: str) -> None:
        """Report that the broker refuses the subscription to commands."""
        self._subscription_problem = problem
        self.report(problem)

    def message_refused(self, problem: str) -> None:
        """Count a message that was refused, and report it if there is no other problem."""
        self.refused += 1
        self._refused_s = time.monotonic()
        if not self.problem:  # the first stands for all that follow
            self.report(problem)

    def message_accepted(self) -> None:
        """End the problem of refused messages if the last refusal is long enough ago."""
        if self.problem and time.monotonic() >= self._refused_s + REFUSED_S:
            self.problem = self._subscription_problem


def refusal(code: ReasonCode, policy: ReconnectPolicy) -> str:
    """Describe a broker's reason code."""
    if code.value in _WHO:
        return f"it refuses our login ({code}): check mqtt.username, mqtt.password_file and the broker's own accounts"
    if code.value in _BUSY:
        return f"it accepts no more connections at present ({code})"
    if code.value == _TAKEN_OVER:
        return f"another client has connected as {policy.client_id}: give one of them another mqtt.client_id"
    return f"it refuses: {code}"


def ended(error: ssl.SSLError | None, *, up: bool, tls: bool) -> str:
    """Describe why a connection ended.

    ``error``: the TLS error, if any; ``up``: the broker had accepted us; ``tls``: TLS is in use.
    """
    if error is not None:
        return _tls(error)
    lost = "the connection was lost"
    missing = "needs a client certificate (mqtt.tls.certificate and key)" if tls else "expects TLS there (mqtt.tls)"
    return lost if up else f"{lost} before the login: it is full, or {missing}, or is not a broker"


def why(error: Exception, target: Target, *, tls: bool) -> str:
    """Describe why no connection could be made.

    ``tls``: TLS is in use.
    """
    if isinstance(error, ssl.SSLError):
        return _tls(error)
    if isinstance(error, socket.gaierror):
        return f"unknown host name ({error.strerror})"
    if isinstance(error, TimeoutError):
        return "it does not answer"
    if isinstance(error, ConnectionRefusedError | FileNotFoundError):
        if target.transport == "unix":
            return "it does not run at present; shmio-supervisor logs broker says why"
        return "nothing listens there"
    if isinstance(error, ConnectionError):
        return "it closed the connection" + (": it may not use TLS there (mqtt.tls, and the port)" if tls else "")
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _tls(error: ssl.SSLError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({error.verify_message}): check mqtt.tls.ca, and the host's name"
    if "_ALERT_" in (error.reason or ""):
        return f"it refuses our TLS ({error.reason}): check mqtt.tls.certificate and key, which it may require"
    return f"the TLS handshake failed ({error.reason or 'it ended the connection'}): check mqtt.tls, and the port"
