"""Which instance a verb acts on."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from shmio.config.model import NAME_RULE, Name
from shmio.config.read import read_tables
from shmio.errors import ConfigError, ControlError, NotRunningError, UnreachableError
from shmio.local.status import supervisor_silence
from shmio.segment import Segment, running_instances
from shmio.supervisor import control

DEFAULT_CONFIG = Path("supervisor.toml")


def config_file(arguments: argparse.Namespace) -> Path:
    """The configuration that a verb reads."""
    return arguments.config or DEFAULT_CONFIG


@dataclass(frozen=True, slots=True)
class Target:
    """The instance that a verb acts on. ``file``: the configuration that names it; None: it was named by itself."""

    name: str
    file: Path | None = None

    def open(self, *, writable: bool = False) -> Segment:
        """Its segment. WrongInstanceError: it was not started from the file that names it; else as Segment.open."""
        return Segment.open(self.name, writable=writable, config=self.file)

    def open_supervised(self) -> Segment:
        """Its segment, if it has a living supervisor; NotRunningError otherwise."""
        segment = self.open()
        if not segment.supervised:
            segment.close()
            raise NotRunningError(
                f"the supervisor of instance {self.name!r} is dead: shmio-supervisor up takes over what it left, "
                f"shmio-supervisor down --instance {self.name} clears it"
            )
        return segment


def target(arguments: argparse.Namespace) -> Target:
    """The instance: as asked, else of the configuration asked for or here, else the only running one.

    ConfigError: not a name, or none in the file; NotRunningError: none runs; ControlError: several do.
    """
    if arguments.instance is not None:
        return Target(_checked("--instance", arguments.instance))
    if arguments.config is not None or DEFAULT_CONFIG.exists():
        file = config_file(arguments)
        return Target(_named_in(file), file)
    running = running_instances()
    if not running:
        raise NotRunningError("no instance is running, and there is no supervisor.toml here")
    if len(running) > 1:
        raise ControlError(f"several instances are running: choose one by --instance ({', '.join(running)})")
    return Target(running[0])


def config_option(arguments: argparse.Namespace) -> str | None:
    """What names the same configuration on another command line: ``-c FILE``, empty for the one that is taken anyway.

    None: the instance was named, or found running, and its configuration is not known.
    """
    if getattr(arguments, "instance", None) is not None:
        return None
    if arguments.config is not None:
        return option_for(arguments.config)
    return "" if DEFAULT_CONFIG.exists() else None


def option_for(file: Path) -> str:
    """What names this configuration on a command line; empty for the one that is taken anyway."""
    return "" if file == DEFAULT_CONFIG else f"-c {shlex.quote(str(file))}"


def ask(segment: Segment, request: control.Request, timeout_s: float) -> dict[str, Any]:
    """The answer of the instance's supervisor; ControlError as soon as it shows no sign of life."""
    try:
        return control.request(segment.header.control, request, timeout_s, lambda: supervisor_silence(segment))
    except UnreachableError as error:
        raise ControlError(f"{error}; kill -TERM {segment.supervisor[0]} stops the instance") from None


def _named_in(file: Path) -> str:
    """The name alone: an instance must be stoppable when its file has been spoilt since."""
    tables = read_tables(file)
    try:
        name = tables["instance"]["name"]
    except (KeyError, TypeError):
        raise ConfigError(f"{file}: instance.name: this key is needed") from None
    return _checked(f"{file}: instance.name", name)


def _checked(key: str, name: object) -> str:
    try:
        return msgspec.convert(name, Name)
    except msgspec.ValidationError:
        raise ConfigError(f"{key}: {name!r} is not a name: {NAME_RULE}") from None
