"""Finds the instance on which a command acts."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import dataclass
from pathlib import Path

import msgspec

from shmio.config.model import NAME_RULE, Name
from shmio.config.read import read_tables
from shmio.errors import ConfigError, ControlError, NotRunningError
from shmio.segment import Segment, running_instances

DEFAULT_CONFIG = Path("supervisor.toml")


def config_file(arguments: argparse.Namespace) -> Path:
    """Return the configuration file that the arguments name, or else the default file."""
    return arguments.config or DEFAULT_CONFIG


@dataclass(frozen=True, slots=True)
class Target:
    """The instance on which a verb acts, and the configuration that names it; ``file`` is None if none does."""

    name: str
    file: Path | None = None

    def open(self, *, writable: bool = False) -> Segment:
        """Open the instance's segment.

        Raises:
            SegmentError: The segment cannot be opened; see :meth:`Segment.open`.
            WrongInstanceError: The instance was started from another file.

        """
        return Segment.open(self.name, writable=writable, config=self.file)

    def open_supervised(self) -> Segment:
        """Open the instance's segment, and check that its supervisor is alive.

        Raises:
            NotRunningError: The supervisor is dead.

        """
        segment = self.open()
        if not segment.supervised:
            segment.close()
            raise NotRunningError(
                f"the supervisor of instance {self.name!r} is dead; take over what is left of the instance with "
                f"shmio-supervisor up, or clear it with shmio-supervisor down --instance {self.name}"
            )
        return segment


def target(arguments: argparse.Namespace) -> Target:
    """Return the instance that an option or the configuration names, or else the only running one.

    Raises:
        ConfigError: The name is invalid, or missing in the file.
        NotRunningError: Nothing names an instance, and none is running.
        ControlError: Nothing names an instance, and several are running.

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
        raise ControlError(f"several instances are running; choose one by --instance ({', '.join(running)})")
    return Target(running[0])


def config_option(arguments: argparse.Namespace) -> str | None:
    """Return the option with which another command selects this command's configuration.

    Returns:
        The option; "" for the default file; None if the configuration is unknown, because
        ``--instance`` named the instance, or the command found the only running instance.
    """
    if getattr(arguments, "instance", None) is not None:
        return None
    if arguments.config is not None:
        return option_for(arguments.config)
    return "" if DEFAULT_CONFIG.exists() else None


def option_for(file: Path) -> str:
    """Return the option with which a command selects a configuration; "" for the default file."""
    return "" if file == DEFAULT_CONFIG else f"-c {shlex.quote(str(file))}"


def _named_in(file: Path) -> str:
    """Read only the instance's name from a file. The rest of the file may be invalid."""
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
