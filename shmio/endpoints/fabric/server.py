"""The NATS server that the instance runs: its configuration and its process."""

from __future__ import annotations

import fcntl
import logging
import os
import re
import shutil
import socket
import ssl
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.config import Address
from shmio.config.fabric import STORE_MB
from shmio.config.model import MqttTls
from shmio.endpoints.server_process import CONNECT_S, Probe, ServerProcess
from shmio.errors import ConfigError, EndpointError, ShmioError
from shmio.fabric.messages import MAX_MESSAGE_BYTES
from shmio.fabric.names import CellName
from shmio.fabric.own_seed import OwnSeed, nobodys_key
from shmio.fabric.permissions import others_permissions
from shmio.fabric.server_version import version_fault

PROGRAM: Final = "nats-server"
CONFIGURATION: Final = "nats-server.conf"
LOCK: Final = "lock"
STOP_S: Final = 5.0
VERSION_S: Final = 5.0
MAX_UNSENT_BYTES: Final = 64 << 20
"""Maximum size of what waits for a slow client, in bytes. Beyond it, the server disconnects the client."""
MAX_MEMORY_BYTES: Final = 256 << 20
"""Maximum size of the streams that the server keeps in memory, in bytes. The fabric keeps all streams on the disk."""
MAX_SUBSCRIPTIONS: Final = 10_000
"""Maximum number of subscriptions of a connection."""
PING: Final = b"PING\r\n"
HELLO: Final = b'CONNECT {"verbose":false,"pedantic":false,"name":"shmio liveness"}\r\n' + PING
MAX_GREETING_BYTES: Final = 1 << 16
_STAMP: Final = re.compile(r"^\[\d+\] (?:\d{4}/\d\d/\d\d \d\d:\d\d:\d\d\.\d+ )?")
_GLOB: Final = re.compile(r"[*?\[]")
_CLIENT: Final = re.compile(r" - cid:\d+ - ")
_LEVEL: Final = re.compile(r"^\[(INF|WRN|ERR|FTL|DBG|TRC)\](?: |$)")

log = logging.getLogger("shmio.fabric")


class ServerSettings(msgspec.Struct, frozen=True):
    """What the server's process needs of the configuration.

    Attributes:
        listen: Address at which clients connect.
        directory: Path of the directory with the server's files.
        tls: PEM files; None: without TLS.
        store_mb: Maximum size in MB of the streams that the server keeps on the disk.
        cell: Name of the instance's cell; None if it has none.
        cells: Patterns for the names of other cells, for which clients without credentials may publish.

    """

    listen: str
    directory: str
    tls: MqttTls | None = None
    store_mb: float = STORE_MB
    cell: str | None = None
    cells: Sequence[str] = ()


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


def _version(program: str) -> str:
    """Return what the server says about its version; empty if it does not."""
    try:
        done = subprocess.run([program, "--version"], capture_output=True, text=True, timeout=VERSION_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""  # its start will show what is wrong
    return done.stdout


def configuration(settings: ServerSettings, name: str, own: str, others: str) -> bytes:
    """Return the server's configuration file. The server also reads JSON.

    All users are in the server's default account, which has the streams of earlier versions.

    Args:
        settings: The address, the directory, the limits and the PEM files.
        name: Name of the server, for its log and its monitoring.
        own: Public NKey of the processes of the server's own user, who may do everything.
        others: Public NKey that the server gives to clients without credentials.

    """
    cell = None if settings.cell is None else CellName.parse(settings.cell)
    permissions = others_permissions(cell, [_subjects(pattern) for pattern in settings.cells])
    listen = Address.parse(settings.listen)
    found: dict[str, Any] = {
        "host": listen.host,
        "port": listen.port,
        "server_name": name,
        "jetstream": {
            "store_dir": settings.directory,
            "max_memory_store": MAX_MEMORY_BYTES,
            "max_file_store": round(settings.store_mb * 1e6),
        },
        "authorization": {"users": [{"nkey": own}, {"nkey": others, "permissions": permissions.section()}]},
        "no_auth_user": others,
        "max_subscriptions": MAX_SUBSCRIPTIONS,
        "max_payload": MAX_MESSAGE_BYTES,
        "max_pending": MAX_UNSENT_BYTES,
    }
    if settings.tls is not None:
        found["tls"] = _tls(settings.tls)
    return msgspec.json.format(msgspec.json.encode(found)) + b"\n"


def _subjects(pattern: str) -> CellName:
    """Return a pattern for names of cells as subjects can have it: a part with a wildcard becomes ``*``.

    It may match more names. The owner of a cell checks the senders of commands by the pattern itself.
    """
    return CellName(*("*" if _GLOB.search(part) else part for part in pattern.split(".")))


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
            EndpointError: The server is too old, or the directory cannot be used.

        """
        check_installed()
        program = str(find_server())
        if fault := version_fault(_version(program)):
            raise EndpointError(f"{program}: {fault}")
        self._listen = Address.parse(settings.listen)
        self._tls = settings.tls
        self._lock = _prepare(Path(settings.directory))
        try:
            self._seed = OwnSeed(self._listen.here)
        except ShmioError as error:
            os.close(self._lock)
            raise EndpointError(str(error)) from None
        file = Path(settings.directory) / CONFIGURATION
        try:
            fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
            with open(fd, "wb") as stream:  # noqa: PTH123  a descriptor
                stream.write(configuration(settings, name, self._seed.key, nobodys_key()))
            command = [program, "-c", str(file)]
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
        self._seed.keep()

    def stop(self) -> None:
        """Stop the server, and release its directory."""
        self._process.stop()
        self._seed.remove()
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
    if kind == "ERR" and _CLIENT.search(text):  # a client may not do what it asked for: the server works
        kind = "WRN"
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
