"""Checks, before an instance starts, that it does not run, and that its ports and log folder are free."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from shmio.errors import AlreadyRunningError, ConfigError, EndpointError, ShmioError
from shmio.plan.ports import check_ports
from shmio.plan.processes import Plan
from shmio.segment import Segment, stale_segment
from shmio.segment.segment import refuse_second

LOCK_NAME: Final = ".instance"


def check_startable(plan: Plan) -> None:
    """Check that an instance can start. Ports that processes of its dead supervisor use count as free.

    Raises:
        AlreadyRunningError: The instance is running; the message says how to stop it.
        EndpointError: A port is in use.

    """
    refuse_running(plan)
    if not stale_segment.living(plan.instance):
        try:
            check_ports(plan)
        except EndpointError:
            refuse_running(plan)  # an instance that has just started may use them
            raise


def refuse_running(plan: Plan) -> None:
    """Raise AlreadyRunningError if the instance is running; the message says from which file, and how to stop it."""
    try:
        refuse_second(plan.instance)
    except AlreadyRunningError as error:
        raise AlreadyRunningError(f"{error}{_whose(plan)}") from None


def _whose(plan: Plan) -> str:
    """Return the end of a message: the file from which the running instance was started, and what to do."""
    down = f"shmio-supervisor down --instance {plan.instance} stops it"
    with suppress(ShmioError), Segment.open(plan.instance) as segment:
        if segment.config not in (None, plan.config_file):
            return f", started from {segment.config}; {down}; or choose another instance.name in this file"
    return f"; {down}"


@contextmanager
def hold_log_folder(folder: Path, instance: str) -> Iterator[None]:
    """Create an instance's folder for log files, and lock it during a ``with`` block.

    Only one instance may use a folder, because the log files of two instances would have the same
    names.

    Raises:
        ConfigError: Another instance uses the folder, or the folder cannot be written.
        AlreadyRunningError: This instance already runs, and uses the folder.

    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Do not follow links, because the file is truncated below.
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
                f"instance.log_dir: instance {other!r} writes its logs to {folder}; give each instance a folder of "
                "its own"
            ) from None
        line = f"{instance}\n".encode()
        os.pwrite(fd, line, 0)  # written before truncating, so that a reader always finds a name
        os.ftruncate(fd, len(line))
        yield
