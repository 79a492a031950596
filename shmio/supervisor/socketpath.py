"""The path of an instance's control socket, in a folder that only its user can enter."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import Final

from shmio.errors import ControlError

MAX_PATH_BYTES: Final = 107  # sun_path holds 108 with the final zero, unix(7)


def socket_path(instance: str) -> str:
    """Return the path of an instance's control socket; create its folder with mode 0700.

    It is in the first usable of ``$XDG_RUNTIME_DIR/shmio``, ``/run/user/<uid>/shmio`` and
    ``/tmp/shmio-<uid>``.

    Raises:
        ControlError: No folder is usable: it belongs to another user, or the path is too long.

    """
    uid = os.getuid()
    given = os.environ.get("XDG_RUNTIME_DIR")
    folders = [Path(given) / "shmio"] if given and Path(given).is_absolute() else []
    folders += [Path(f"/run/user/{uid}/shmio"), Path(f"/tmp/shmio-{uid}")]  # noqa: S108  made with care below
    refused = []
    for folder in folders:
        path = folder / f"{instance}.sock"
        if len(os.fsencode(path)) > MAX_PATH_BYTES:
            refused.append(f"{folder}: the path is longer than {MAX_PATH_BYTES} bytes")
            continue
        reason = _prepare(folder, uid)
        if reason is None:
            return str(path)
        refused.append(f"{folder}: {reason}")
    raise ControlError(f"no folder for the control socket ({'; '.join(refused)})")


def _prepare(folder: Path, uid: int) -> str | None:
    """Create a folder for this user alone; return why not, or None.

    Symbolic links are not followed.
    """
    try:
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            if os.fstat(fd).st_uid != uid:
                return "belongs to another user"
            os.fchmod(fd, 0o700)
        finally:
            os.close(fd)
    except OSError as error:
        return error.strerror
    return None


def remove_socket(path: str) -> None:
    """Remove a socket. Anything else of that name stays, and bind reports it."""
    with suppress(FileNotFoundError):
        if stat.S_ISSOCK(os.lstat(path).st_mode):
            Path(path).unlink()
