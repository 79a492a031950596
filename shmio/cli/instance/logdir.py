"""A folder of log files belongs to one instance: those of another would have the same names."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from shmio.errors import AlreadyRunningError, ConfigError

LOCK_NAME = ".instance"


@contextmanager
def held(folder: Path, instance: str) -> Iterator[None]:
    """Hold a folder, which is made, as long as the supervisor lives.

    ConfigError: another instance has it; AlreadyRunningError: the instance itself, which another process has begun.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # It is truncated: not what a link put there by somebody leads to.
        fd = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        raise ConfigError(f"instance.log_dir: cannot write {folder / LOCK_NAME}: {error.strerror}") from None
    with os.fdopen(fd, "r+", encoding="utf-8", errors="replace") as file:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            if (other := file.read(64).strip()) == instance:
                raise AlreadyRunningError(f"instance {instance!r} is already running, or just starting") from None
            raise ConfigError(
                f"instance.log_dir: instance {other!r} writes its logs to {folder}: give each instance a folder of "
                "its own"
            ) from None
        line = f"{instance}\n".encode()
        os.pwrite(fd, line, 0)  # before what was there is cut off: who looks meanwhile sees a name
        os.ftruncate(fd, len(line))
        yield
