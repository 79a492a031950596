"""Creates and removes the files of UNIX sockets at which shmio listens."""

from __future__ import annotations

import os
import secrets
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from shmio.config.folder import unwritable
from shmio.errors import EndpointError


def clear(path: str) -> None:
    """Remove a socket file that a killed process has left.

    Raises:
        EndpointError: Another process listens at the path, the file is not a socket, or the file
            cannot be removed.

    """
    if (reason := obstacle(path)) is not None:
        raise EndpointError(f"cannot listen on unix:{path}: {reason}")
    try:
        Path(path).unlink(missing_ok=True)
    except OSError as error:  # another user's file in a shared folder
        raise EndpointError(
            f"cannot listen on unix:{path}: the socket of an earlier process cannot be removed ({error.strerror}); "
            "ask its owner to remove it, or choose another path"
        ) from None


def remove_left(path: str) -> None:
    """Remove a socket file at which no process listens, if there is one and this user may remove it."""
    with suppress(OSError):
        if stat.S_ISSOCK(os.lstat(path).st_mode) and not listened_on(path):
            Path(path).unlink()


def obstacle(path: str) -> str | None:
    """Return why processes of this user cannot listen at a path; None if they can."""
    folder = Path(path).parent
    if not folder.is_dir():
        return f"there is no folder {folder}; create it, or choose another path"
    if (found := unwritable(folder)) and not found.full:
        return found.reason
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return None
    if not stat.S_ISSOCK(mode):
        return "a file of this name exists and is not a socket; move it away, or choose another path"
    if listened_on(path):
        return f"another program listens there; choose another path, or find that program with ss -xlp src {path}"
    return None


def listened_on(path: str) -> bool:
    """Return whether a process listens at a path. This works even if this user may not connect."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)  # the listener's backlog may be full
        try:
            probe.connect(path)
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True
    return True


class SocketFile:
    """The file of a UNIX socket, which this process creates, and removes when it stops listening."""

    def __init__(self, path: str, gid: int | None) -> None:
        """Set the path, and the group whose members may connect; if ``gid`` is None, only this user may connect."""
        self._path = path
        self._gid = gid
        self._inode = 0

    @contextmanager
    def binding(self) -> Iterator[str]:
        """Yield a temporary path to which to bind the socket; at the end, move the socket to its own path.

        Other users cannot enter the temporary folder, so they cannot connect before the socket has
        its final mode. (Setting the umask instead would affect all threads of the process.)

        Raises:
            EndpointError: The socket cannot be created, or a file with its path exists.

        """
        path, name = Path(self._path), secrets.token_hex(8)
        try:
            with TemporaryDirectory(prefix=".shmio-", dir=path.parent) as folder:
                # The path uses the folder's descriptor, because a socket's path must be short.
                inside = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
                try:
                    yield f"/proc/self/fd/{inside}/{name}"
                    made = Path(folder) / name
                    if self._gid is not None:
                        os.chown(made, -1, self._gid)
                    made.chmod(0o600 if self._gid is None else 0o660)
                    os.link(made, path)  # a rename would replace a file that appeared meanwhile
                    self._inode = os.lstat(path).st_ino
                finally:
                    os.close(inside)
        except OSError as error:
            raise EndpointError(f"unix:{self._path}: {error.strerror}") from None

    def remove(self) -> None:
        """Remove the socket's file, unless another file has replaced it."""
        with suppress(FileNotFoundError):
            if os.lstat(self._path).st_ino == self._inode:
                Path(self._path).unlink()
