"""The file of a UNIX socket to listen on: who has it, whether it may be cleared, who may open it."""

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
    """Remove a socket that nobody listens on any more, as a killed process leaves it.

    EndpointError: the file is in the way; it is another process's, or no socket.
    """
    if (reason := obstacle(path)) is not None:
        raise EndpointError(f"cannot listen on unix:{path}: {reason}")
    try:
        Path(path).unlink(missing_ok=True)
    except OSError as error:  # another user's, in a folder for all
        raise EndpointError(
            f"cannot listen on unix:{path}: what another process has left there cannot be removed ({error.strerror}): "
            "have its owner do it, or choose another path"
        ) from None


def obstacle(path: str) -> str | None:
    """Why a process of this user cannot listen there; None if it can."""
    folder = Path(path).parent
    if not folder.is_dir():
        return f"there is no folder {folder}: mkdir -p it, or choose another path"
    if (found := unwritable(folder)) and not found.full:
        return found.reason
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return None
    if not stat.S_ISSOCK(mode):
        return "there is a file of that name that is no socket: move it away, or choose another path"
    if listened_on(path):
        return f"another program listens there; choose another path, or see which: ss -xlp src {path}"
    return None


def listened_on(path: str) -> bool:
    """Whether somebody listens there; of one that may not be opened it is taken for granted."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)  # its queue may be full
        try:
            probe.connect(path)
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True
    return True


class SocketFile:
    """A socket that this process makes, to be removed when it no longer listens."""

    def __init__(self, path: str, gid: int | None) -> None:
        """Its user may open it, or a group's users as well."""
        self._path = path
        self._gid = gid
        self._inode = 0

    @contextmanager
    def binding(self) -> Iterator[str]:
        """Where to bind it; afterwards it is at its path. EndpointError: it cannot be, or something is there by now.

        That is in a folder which nobody else can enter: nobody opens the socket before it has its mode, whatever the
        process's umask is, which all threads share.
        """
        path, name = Path(self._path), secrets.token_hex(8)
        try:
            with TemporaryDirectory(prefix=".shmio-", dir=path.parent) as folder:
                # By its descriptor, for a socket's path must be short.
                inside = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
                try:
                    yield f"/proc/self/fd/{inside}/{name}"
                    made = Path(folder) / name
                    if self._gid is not None:
                        os.chown(made, -1, self._gid)
                    made.chmod(0o600 if self._gid is None else 0o660)
                    os.link(made, path)  # not renamed: that would take the place of what is there by now
                    self._inode = os.lstat(path).st_ino
                finally:
                    os.close(inside)
        except OSError as error:
            raise EndpointError(f"unix:{self._path}: {error.strerror}") from None

    def remove(self) -> None:
        """Remove it, unless somebody else has one of that name by now."""
        with suppress(FileNotFoundError):
            if os.lstat(self._path).st_ino == self._inode:
                Path(self._path).unlink()
