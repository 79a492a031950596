"""Replaces files at once, so that a reader sees the old content or the whole new one."""

from __future__ import annotations

import os
import secrets
from contextlib import suppress
from pathlib import Path


def replace_file(file: Path, data: bytes, *, private: bool) -> None:
    """Write a file. Until all of it is written, readers see the older file.

    Args:
        file: The file. If it is a symbolic link, the link is replaced.
        data: The new content.
        private: Whether only this user may read the file. Otherwise it has the permissions of the older
            file, or those of any new file.

    Raises:
        OSError: The file cannot be written. Nothing of the new content remains.
    """
    new = file.with_name(f".shmio-{secrets.token_hex(8)}")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600 if private else 0o666)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            if not private and file.exists():
                os.fchmod(descriptor, file.stat().st_mode & 0o777)
        new.replace(file)
    except BaseException:
        with suppress(OSError):
            new.unlink()
        raise
