"""The NATS server that the instance runs: its configuration and its process."""

from __future__ import annotations

import fcntl
import logging
import os
import re
import shutil
import socket
import ssl
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.config import Address
from shmio.config.model import MqttTls
from shmio.endpoints.server_process import CONNECT_S, Probe, ServerProcess
from shmio.errors import ConfigError, EndpointError
from shmio.fabric.messages import MAX_MESSAGE_BYTES

PROGRAM: Final = "nats-server"
CONFIGURATION: Final = "nats-server.conf"
LOCK: Final = "lock"
STOP_S: Final = 5.0
MAX_UNSENT_BYTES: Final = 64 << 20
"""Maximum size of what waits for a slow client, in bytes. Beyond it, the server disconnects the client."""
MAX_MEMORY_BYTES: Final = 256 << 20
"""Maximum size of the streams that the server keeps in memory, in bytes. The fabric keeps all streams on the disk."""
PING: Final = b"PING\r\n"
HELLO: Final = b'CONNECT {"verbose":false,"pedantic":false,"name":"shmio liveness"}\r\n' + PING
MAX_GREETING_BYTES: Final = 1 << 16
_STAMP: Final = re.compile(r"^\[\d+\] (?:\d{4}/\d\d/\d\d \d\d:\d\d:\d\d\.\d+ )?")
_LEVEL: Final = re.compile(r"^\[(INF|WRN|ERR|FTL|DBG|TRC)\](?: |$)")

log = logging.getLogger("shmio.fabric")


class ServerSettings(msgspec.Struct, frozen=True):
    """What the server's process needs of the configuration.

    Attributes:
        listen: Address at which clients connect.
        directory: Path of the directory with the server's files.
        tls: PEM files; None: without TLS.

    """

    listen: str
    directory: str
    tls: MqttTls | None = None


def find_server() -> str | None:
    """Return the path of the NATS server; None if it is not installed."""
    own = Path(sys.executable).with_name(PROGRAM)  # where pip installs it
    return str(own) if os.access(own, os.X_OK) else shutil.which(PROGRAM)


def check_installed() -> None:
    """Check that the NATS server is installed.

    Raises:
        ConfigError: It is not installed.

    """
    if find_server() is None:
        raise ConfigError(
            "fabric.server: the embedded NATS server is not installed; run pip install 'shmio[fabric]', or set "
            "fabric.server to the URL of another server"
        )


def configuration(settings: ServerSettings, name: str) -> bytes:
    """Return the server's configuration file. The server also reads JSON.

    Args:
        settings: The address, the directory and the PEM files.
        name: Name of the server, for its log and its monitoring.

    """
    listen = Address.parse(settings.listen)
    found: dict[str, Any] = {
        "host": listen.host,
        "port": listen.port,
        "server_name": name,
        "jetstream": {"store_dir": settings.directory, "max_memory_store": MAX_MEMORY_BYTES},
        "max_payload": MAX_MESSAGE_BYTES,
        "max_pending": MAX_UNSENT_BYTES,
    }
    if settings.tls is not None:
        found["tls"] = _tls(settings.tls)
    return msgspec.json.format(msgspec.json.encode(found)) + b"\n"


def _tls(tls: MqttTls) -> Mapping[str, Any]:
    files = {"cert_file": tls.certificate, "key_file": tls.key}
    return files if tls.ca is None else {**files, "ca_file": tls.ca, "verify": True}


def _client_context(tls: MqttTls) -> ssl.SSLContext:
    """Return a TLS context for a client that asks only whether the server answers, not who it is."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    if tls.ca is not None and tls.certificate is not None:  # clients need a certificate
        context.load_cert_chain(tls.certificate, tls.key)
    return context


class NatsServer:
    """The NATS server and its directory. Start it from the main thread: see :class:`ServerProcess`."""

    def __init__(self, settings: ServerSettings, name: str) -> None:
        """Start the server.

        Raises:
            ConfigError: The server is not installed.
            EndpointError: The directory cannot be used.

        """
        check_installed()
        self._listen = Address.parse(settings.listen)
        self._tls = settings.tls
        self._lock = _prepare(Path(settings.directory))
        file = Path(settings.directory) / CONFIGURATION
        try:
            fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
            with open(fd, "wb") as stream:  # noqa: PTH123  a descriptor
                stream.write(configuration(settings, name))
            command = [str(find_server()), "-c", str(file)]
            self._process = ServerProcess("the NATS server", command, STOP_S, _read, Probe(self._connect, HELLO, PING))
        except OSError as error:
            os.close(self._lock)
            raise EndpointError(f"{file}: {error.strerror}") from None

    def await_start(self, beat: Callable[[], object]) -> None:
        """Wait until the server accepts connections; see :meth:`ServerProcess.await_start`."""

        def accepts() -> bool:
            self._connect().close()
            return True

        self._process.await_start(accepts, beat)

    def _connect(self) -> socket.socket:
        """Connect as a client, with TLS if the server demands it."""
        here = self._listen.here
        connection = socket.create_connection((here.host, here.port), CONNECT_S)
        try:
            greeting = b""
            while not greeting.endswith(b"\r\n") and len(greeting) < MAX_GREETING_BYTES:
                if not (data := connection.recv(MAX_GREETING_BYTES)):
                    raise ConnectionResetError
                greeting += data
            return connection if self._tls is None else _client_context(self._tls).wrap_socket(connection)
        except BaseException:
            connection.close()
            raise

    @property
    def problem(self) -> str:
        """The problem of the running server; empty if there is none."""
        return self._process.problem

    def check(self) -> None:
        """Check that the server is running and answers; raise EndpointError if it has ended or hangs."""
        self._process.check()

    def stop(self) -> None:
        """Stop the server, and release its directory."""
        self._process.stop()
        os.close(self._lock)


def _read(line: str) -> str:
    """Copy a line of the server's log to the log of this process; return it if it reports an error."""
    text = _STAMP.sub("", line)
    level = _LEVEL.match(text)
    text = text[level.end() :] if level else text
    kind = level.group(1) if level else "ERR"
    if kind == "INF":
        log.debug("nats-server: %s", text)
        return ""
    log.log(logging.WARNING if kind == "WRN" else logging.ERROR, "nats-server: %s", text)
    return text if kind in ("ERR", "FTL") else ""


def _prepare(directory: Path) -> int:
    """Create the directory, and return a descriptor of its lock file, which no other server may hold.

    Raises:
        EndpointError: The directory cannot be used.

    """
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        fd = os.open(directory / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise EndpointError(f"fabric.directory: {directory}: {error.strerror}") from None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(fd)
        raise EndpointError(
            f"fabric.directory: {directory}: another NATS server uses this directory; choose another one"
        ) from None
    return fd
