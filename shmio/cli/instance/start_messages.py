"""What a supervisor that starts detached tells the process that waits for it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from shmio.segment import PREFIX


class Configured(msgspec.Struct, tag=True):
    """A detached supervisor has read its configuration."""

    log_file: str
    warnings: tuple[str, ...]


class Started(msgspec.Struct, tag=True):
    """Everything runs.

    ``history``: what was found of an earlier supervisor; ``processes``: the processes, a line each.
    """

    instance: str
    history: list[str]
    processes: list[str]


class Failed(msgspec.Struct, tag=True):
    """The start has failed."""

    error: str


StartMessage = Configured | Started | Failed
"""A message is a line of JSON, of printable text."""


def headline(instance: str, mode: str, segment_bytes: int | None, log_dir: Path) -> str:
    """Return the first line about an instance. ``segment_bytes``: None before a take-over."""
    size = "" if segment_bytes is None else f" ({segment_bytes / 1e6:.1f} MB)"
    return f"{instance}: mode {mode}, segment {PREFIX}{instance}{size}, logs in {log_dir}"
