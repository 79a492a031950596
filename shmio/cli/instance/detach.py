"""``shmio-supervisor up --detach``: starts an instance in another process, and waits until it runs.

This process only waits, so it does not import the modules that start an instance.
"""

from __future__ import annotations

import argparse
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.cli.common import exit_on_signals, say
from shmio.cli.target import config_file, option_for
from shmio.errors import ConfigError, ControlError
from shmio.local.status import InstanceStatus, SourceStatus, problems, read_status
from shmio.segment import PREFIX
from shmio.supervisor.process import child_environment

DETACH_S = 120.0
"""Maximum time in s that the start of a detached instance may take."""
_OPTIONS: Final = ("from", "start", "end", "speed", "injections")
_FLAGS: Final = ("loop", "paused", "record")


class Configured(msgspec.Struct, tag=True):
    """Message of a detached supervisor: it has read its configuration."""

    log_file: str
    warnings: tuple[str, ...]


class Started(msgspec.Struct, tag=True):
    """Message of a detached supervisor: its instance runs.

    ``history`` says what an earlier supervisor left behind; ``processes`` has a line for each
    process.
    """

    instance: str
    history: list[str]
    processes: list[str]


class Failed(msgspec.Struct, tag=True):
    """Message of a detached supervisor: the instance cannot be started.

    ``faulty`` is True if the configuration is the reason.
    """

    error: str
    faulty: bool = False


StartMessage = Configured | Started | Failed
"""A message about the start of an instance, sent as one line of JSON without control characters."""


def detach(arguments: argparse.Namespace) -> int:
    """Start the instance in another process, and return once it runs."""
    file, mode = config_file(arguments), arguments.mode
    with exit_on_signals():  # if the wait is interrupted, the instance ends, too
        log_file, started = start(file, mode, replay_words(replay_keys(arguments)))
    for line in started.history:
        say(line)
    status = read_status(started.instance)
    say(headline(started.instance, mode, status.segment_bytes, Path(log_file).parent))
    for line in started.processes:
        say(line)
    _tell_how(status, option_for(file))
    return 0


def start(file: Path, mode: str, words: Sequence[str] = ()) -> tuple[str, Started]:
    """Start an instance in another process, and wait until it runs.

    Args:
        file: The configuration.
        mode: The mode of the instance.
        words: Further options for ``shmio-supervisor up``.

    Returns:
        Path of the supervisor's log file, and the supervisor's message.

    Raises:
        ConfigError: The configuration cannot be used.
        ControlError: The start failed for another reason.

    """
    command = (sys.executable, "-P", "-m", "shmio.cli.supervisor", "up")
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as answers:
        child = subprocess.Popen(
            [*command, "-c", str(file), "--mode", mode, "--report", str(writer), *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # the child shares stderr until it has opened its log file
            pass_fds=(writer,),
            env=child_environment(),
            start_new_session=True,
        )
        os.close(writer)
        try:
            found = _await(answers.fileno())
        except BaseException:
            child.terminate()
            child.wait()
            raise
    child.returncode = 0  # keeps Popen from warning that the child still runs
    return found


def headline(instance: str, mode: str, segment_bytes: int | None, log_dir: Path) -> str:
    """Return the first line to print about an instance that has started.

    Args:
        instance: Name of the instance.
        mode: The mode in which it runs.
        segment_bytes: Size of the segment in bytes; None if an earlier segment is taken over, whose
            size is not known yet.
        log_dir: The directory of its log files.
    """
    size = "" if segment_bytes is None else f" ({segment_bytes / 1e6:.1f} MB)"
    return f"{instance}: mode {mode}, segment {PREFIX}{instance}{size}, logs in {log_dir}"


def replay_keys(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the keys of ``[replay]`` that the command line sets.

    Raises:
        ConfigError: The command line sets such keys, but the mode is not ``replay``.

    """
    found = {name: getattr(arguments, name) for name in (*_OPTIONS, *_FLAGS) if getattr(arguments, name) is not None}
    if found and arguments.mode != "replay":
        raise ConfigError(f"--{next(iter(found))} is only for --mode replay")
    if "from" in found:
        found["file"] = [str(Path(file).absolute()) for file in found.pop("from")]
    return {name: _moment(value) if name in ("start", "end") else value for name, value in found.items()}


def replay_words(keys: Mapping[str, Any]) -> list[str]:
    """Return keys of ``[replay]`` as options for the command line of the detached supervisor."""
    words: list[str] = []
    for name, value in keys.items():
        if name == "file":
            words += ["--from", *value]
        else:
            words += [f"--{name}"] if value is True else [f"--{name}={value}"]
    return words


def _await(fd: int) -> tuple[str, Started]:
    """Wait for the start; return the log file and the message.

    Raises:
        ConfigError: The configuration cannot be used.
        ControlError: The start failed for another reason.

    """
    log_file = ""
    try:
        for line in _lines(fd):
            message = msgspec.json.decode(line, type=StartMessage)
            if isinstance(message, Started):
                return log_file, message
            if isinstance(message, Failed):
                raise ConfigError(message.error) if message.faulty else ControlError(message.error)
            log_file = message.log_file
            for warning in message.warnings:
                say(warning, sys.stderr)
    except TimeoutError:
        see = f"; see {log_file}" if log_file else ""
        raise ControlError(
            f"the instance was not running after {DETACH_S:g} s, so this command stopped it{see}"
        ) from None
    raise ControlError(f"the supervisor died while it started; see {log_file or 'above'}")


def _lines(fd: int) -> Iterator[bytes]:
    """Yield the lines that arrive through the pipe. Raise TimeoutError after ``DETACH_S``."""
    deadline = time.monotonic() + DETACH_S
    received = b""
    while True:
        ready, _, _ = select.select([fd], [], [], max(0.0, deadline - time.monotonic()))
        if not ready:
            raise TimeoutError
        data = os.read(fd, 65536)
        if not data:
            return
        *lines, received = (received + data).split(b"\n")
        yield from lines


def _tell_how(status: InstanceStatus, option: str) -> None:
    for problem in problems(status):
        say(f"warning: {problem}", sys.stderr)
    for process in status.processes:
        if isinstance(process, SourceStatus) and process.quality == "bad":
            say(f"warning: source {process.name} is bad: {process.reason}", sys.stderr)
    pid = status.supervisor.pid if status.supervisor else None
    down = f"shmio-supervisor down {option}".rstrip()
    say(f"{status.state}, supervisor pid {pid}; {down} stops it")


def _moment(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
