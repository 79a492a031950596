"""``shmio-dump note``: what somebody has to say, between the frames of a running instance."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path

from shmio.cli.target import instance_name
from shmio.config import load
from shmio.errors import ConfigError, ControlError
from shmio.segment import Segment
from shmio.segment.attach import attach
from shmio.supervisor import control

WHERE_S = 2.0


def execute(arguments: argparse.Namespace) -> int:
    """Send the note, and wait until it is there."""
    name = instance_name(arguments)
    source = arguments.source if arguments.source is not None else _default_source(name)
    with attach(name, writable=True) as cell:
        cell.note(arguments.text, source if source in cell.sources or arguments.source is not None else None)
    return 0


def _default_source(name: str) -> str | None:
    """The source that clients mean who name none, if the configuration can be asked."""
    with suppress(ControlError, ConfigError, KeyError), Segment.open(name) as segment:
        config = load(Path(control.request(segment.header.control, control.Where(), WHERE_S)["config"]))
        return config.grpc.default_source if config.grpc else None
    return None
