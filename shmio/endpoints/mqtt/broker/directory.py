"""The folder of our own broker: beside the supervisor's socket, this user's alone."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from shmio.errors import EndpointError
from shmio.segment import Segment

SOCKET: Final = "s"
"""So short that its path is no longer than that of the supervisor's socket, which fits where such may be."""

SECRET: Final = "key"  # noqa: S105  a name
"""The bridge's password."""


def folder(segment: Segment) -> Path:
    """Where it is; not made here."""
    return Path(f"{segment.header.control.removesuffix('.sock')}.mq")


def own_socket(segment: Segment) -> str:
    """Where our own broker is reached by us alone."""
    return str(folder(segment) / SOCKET)


def secret_of(socket: str) -> str:
    """The bridge's password at the broker of a socket. FileNotFoundError: the broker does not run."""
    return Path(socket).with_name(SECRET).read_text(encoding="utf-8")


def write_private(file: Path, text: str) -> None:
    """Make a file, mode 0600, which is not there yet."""
    fd = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(fd, "w", encoding="utf-8") as stream:  # noqa: PTH123  a descriptor
        stream.write(text)


def prepare(place: Path) -> None:
    """Make it, mode 0700, and empty it. EndpointError: it is something else, or somebody else's."""
    try:
        place.mkdir(mode=0o700, exist_ok=True)
        fd = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            if os.fstat(fd).st_uid != os.getuid():
                raise EndpointError(f"the broker's folder {place} belongs to another user")
            os.fchmod(fd, 0o700)
        finally:
            os.close(fd)
        clear(place)
    except OSError as error:
        raise EndpointError(f"the broker's folder {place}: {error.strerror}") from None


def clear(place: Path) -> None:
    """Remove what is in it."""
    for entry in place.iterdir():
        if not entry.is_dir():
            entry.unlink(missing_ok=True)


def remove(place: Path) -> None:
    """Remove it."""
    clear(place)
    place.rmdir()
