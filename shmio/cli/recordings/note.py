"""``shmio-dump note``: adds a note to the events of a running instance."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path

from shmio import control
from shmio.cli.target import target
from shmio.config import load
from shmio.errors import ConfigError, ControlError
from shmio.local.attach import Attachment
from shmio.segment import Segment

WHERE_S = 2.0


def note(arguments: argparse.Namespace) -> int:
    """Send the note, and wait until the source has published it."""
    with Attachment(target(arguments).open(writable=True)) as cell:
        source = arguments.source if arguments.source is not None else _default_source(cell.instance)
        cell.note(arguments.text, source if source in cell.sources or arguments.source is not None else None)
    return 0


def _default_source(name: str) -> str | None:
    """Return the default source of clients; None if the configuration cannot be read."""
    with suppress(ControlError, ConfigError, KeyError), Segment.open(name) as segment:
        config = load(Path(control.request(segment.header.control, control.Where(), WHERE_S)["config"]))
        return config.grpc.default_source if config.grpc else None
    return None
