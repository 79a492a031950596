"""Read files that hold a secret and that only their owner may access."""

from __future__ import annotations

import os
import stat
from typing import Final

from shmio.errors import ConfigError

_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO


def read_secret(key: str, name: str, most_bytes: int, *, instead: str) -> bytes:
    """Return the first ``most_bytes`` bytes of a secret's file.

    Args:
        key: The configuration key, with which messages begin.
        name: Path of the file.
        most_bytes: Maximum number of bytes to read.
        instead: The replacement to make if others could have read the secret, for the message.

    Raises:
        ConfigError: The file cannot be read, or others may access it; never quotes its contents.

    """
    try:
        fd = os.open(name, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # else a pipe without a writer blocks
    except OSError as error:
        raise ConfigError(f"{key}: {error.strerror}") from None
    try:
        mode = os.fstat(fd).st_mode
        if not stat.S_ISREG(mode):
            raise ConfigError(f"{key}: not a file")
        if mode & _OTHERS:
            raise ConfigError(
                f"{key}: mode {stat.S_IMODE(mode):04o} lets other users read it: chmod 600, and {instead}"
            )
        return os.read(fd, most_bytes)
    finally:
        os.close(fd)
