"""A file that holds a secret: its user's alone."""

from __future__ import annotations

import os
import stat
from typing import Final

from shmio.errors import ConfigError

_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO


def read_secret(key: str, name: str, most_bytes: int, *, instead: str) -> bytes:
    """Its bytes, at most so many. ConfigError, beginning with ``key``, never says what is in it.

    ``instead``: what is to be made anew if others could have read it.
    """
    try:
        fd = os.open(name, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # which a pipe without a writer would block
    except OSError as error:
        raise ConfigError(f"{key}: {error.strerror}") from None
    try:
        mode = os.fstat(fd).st_mode
        if not stat.S_ISREG(mode):
            raise ConfigError(f"{key}: not a file")
        if mode & _OTHERS:
            raise ConfigError(f"{key}: mode {stat.S_IMODE(mode):04o} lets others in: chmod 600, and {instead}")
        return os.read(fd, most_bytes)
    finally:
        os.close(fd)
