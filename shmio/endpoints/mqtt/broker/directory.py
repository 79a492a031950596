"""The directory of our own broker: beside the supervisor's socket, readable by this user only."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from shmio.errors import EndpointError
from shmio.segment import Segment

SOCKET: Final = "s"
"""Name of the socket.

Its path must be no longer than that of the supervisor's socket.
"""

SECRET: Final = "key"  # noqa: S105  a name
"""Name of the file with the bridge's password."""


def folder(segment: Segment) -> Path:
    """Return the directory's path; the directory need not exist."""
    return Path(f"{segment.header.control.removesuffix('.sock')}.mq")


def own_socket(segment: Segment) -> str:
    """Return the path of the broker's UNIX socket, which only this user can reach."""
    return str(folder(segment) / SOCKET)


def secret_of(socket: str) -> str:
    """Read the bridge's password for the broker of a socket.

    Raises:
        FileNotFoundError: The broker does not run.

    """
    return Path(socket).with_name(SECRET).read_text(encoding="utf-8")


def write_private(file: Path, text: str) -> None:
    """Create a file with mode 0600; it must not exist."""
    fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(fd, "w", encoding="utf-8") as stream:  # noqa: PTH123  a descriptor
        stream.write(text)


def prepare(place: Path) -> None:
    """Create the directory with mode 0700, or empty it.

    Raises:
        EndpointError: It is not a directory, or belongs to another user.

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
        raise EndpointError(f"the broker's folder {place}: {error.strerror}") from None


def clear(place: Path) -> None:
    """Remove the directory's files."""
    for entry in place.iterdir():
        if not entry.is_dir():
            entry.unlink(missing_ok=True)


def remove(place: Path) -> None:
    """Remove the directory and its files."""
    clear(place)
    place.rmdir()
