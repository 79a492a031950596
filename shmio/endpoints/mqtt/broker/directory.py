"""The directory of the instance's own broker, with its socket and the bridge's password.

The directory is next to the supervisor's socket, and only this user can read it. Each start of the
broker makes a new password. The broker accepts this password only on its UNIX socket.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from pathlib import Path
from typing import Final

from shmio.config.credentials import hashed
from shmio.errors import EndpointError
from shmio.segment import Segment

SOCKET: Final = "s"
"""Name of the broker's socket. Its path must not be longer than the path of the supervisor's socket."""
SECRET: Final = "key"  # noqa: S105  a name
"""Name of the file with the bridge's password."""
BRIDGE: Final = "bridge"
"""Name of the bridge's account."""
ID: Final = re.compile(r"(?<=-)[0-9a-f]{32}\b")
"""Pattern for the secret part of a client id; see :func:`secret_id`."""


def folder(segment: Segment) -> Path:
    """Return the path of the directory, which need not exist."""
    return Path(f"{segment.header.control.removesuffix('.sock')}.mq")


def own_socket(segment: Segment) -> str:
    """Return the path of the broker's UNIX socket, which only this user can reach."""
    return str(folder(segment) / SOCKET)


def write_private(file: Path, text: str) -> None:
    """Create a file with mode 0600 and this text. The file must not exist yet."""
    fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(fd, "w", encoding="utf-8") as stream:  # noqa: PTH123  a descriptor
        stream.write(text)


def prepare(place: Path) -> None:
    """Create the directory with mode 0700; if it exists, remove its files.

    Raises:
        EndpointError: The path is not a directory, belongs to another user, or cannot be created.

    """
    try:
        place.mkdir(mode=0o700, exist_ok=True)
        fd = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            if os.fstat(fd).st_uid != os.getuid():
                raise EndpointError(f"the broker's directory {place} belongs to another user")
            os.fchmod(fd, 0o700)
        finally:
            os.close(fd)
        clear(place)
    except OSError as error:
        raise EndpointError(f"cannot create the broker's directory {place}: {error.strerror}") from None


def clear(place: Path) -> None:
    """Remove all files in the directory."""
    for entry in place.iterdir():
        if not entry.is_dir():
            entry.unlink(missing_ok=True)


def remove(place: Path) -> None:
    """Remove the directory, with its files."""
    clear(place)
    place.rmdir()


def new_secret(place: Path) -> str:
    """Make the bridge's password, write it to its file, and return its hash for mosquitto."""
    secret = secrets.token_hex(32)
    write_private(place / SECRET, secret)
    return hashed(secret)


def secret_of(socket: str) -> str:
    """Read the bridge's password from the directory of the broker with this socket.

    Raises:
        FileNotFoundError: The broker is not running.

    """
    return Path(socket).with_name(SECRET).read_text(encoding="utf-8")


def secret_id(client_id: str, secret: str) -> str:
    """Return a client id that others cannot guess: ``client_id`` with a secret part.

    Anyone who knows the id of a client can disconnect that client.
    """
    return f"{client_id}-{hashlib.sha256(f'{secret} {client_id}'.encode()).hexdigest()[:32]}"
