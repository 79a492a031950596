"""Writes files whole or not at all, and names the file in errors, such as that of a full disk."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
    with _naming(file):
        _replace(file, data, private=private)


def create_file(file: Path, data: bytes, *, private: bool = False) -> None:
    """Write a new file.

    Args:
        file: The file.
        data: Its content.
        private: Whether only this user may read the file.

    Raises:
        FileExistsError: The file, or a symbolic link of this name, exists already, and was not changed.
        OSError: The file cannot be written. It does not exist.

    """
    with _naming(file):
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600 if private else 0o666)
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(data)
        except BaseException:
            with suppress(OSError):
                file.unlink()
            raise


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Let errors name a file; those of a full disk do not."""
    try:
        yield
    except OSError as error:
        error.filename = str(file)
        raise


def _replace(file: Path, data: bytes, *, private: bool) -> None:
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
