"""Messages from a detached supervisor to the process that waits for its start."""

from __future__ import annotations

from pathlib import Path

import msgspec

from shmio.segment import PREFIX


class Configured(msgspec.Struct, tag=True):
    """A detached supervisor has read its configuration."""

    log_file: str
    warnings: tuple[str, ...]


class Started(msgspec.Struct, tag=True):
    """The instance runs.

    ``history`` says what an earlier supervisor left; ``processes`` has a line for each process.
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
