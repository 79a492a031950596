"""Find the instance that a command acts on, here or behind an endpoint."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from shmio.cli.interrupt import ended_by_interrupt
from shmio.config.address import UNIX, Address
from shmio.config.model import NAME_RULE, Name
from shmio.config.read import read_tables
from shmio.errors import ConfigError, ControlError, NotRunningError, UnknownClientError, UnreachableError
from shmio.local.attach import Attachment
from shmio.local.status import supervisor_silence
from shmio.model.cell import Cell
from shmio.segment import Segment, running_instances
from shmio.supervisor import control

DEFAULT_CONFIG = Path("supervisor.toml")


def config_file(arguments: argparse.Namespace) -> Path:
    """Return the configuration file that a verb reads."""
    return arguments.config or DEFAULT_CONFIG


@dataclass(frozen=True, slots=True)
class Target:
    """The instance that a verb acts on, and the configuration that names it, if any."""

    name: str
    file: Path | None = None

    def open(self, *, writable: bool = False) -> Segment:
        """Open the instance's segment, with the errors of Segment.open.

        WrongInstanceError: the instance was started from another file.
        """
        return Segment.open(self.name, writable=writable, config=self.file)

    def open_supervised(self) -> Segment:
        """Open the instance's segment; NotRunningError if its supervisor is dead."""
        segment = self.open()
        if not segment.supervised:
            segment.close()
            raise NotRunningError(
                f"the supervisor of instance {self.name!r} is dead: shmio-supervisor up takes over what it left, "
                f"shmio-supervisor down --instance {self.name} clears it"
            )
        return segment


def target(arguments: argparse.Namespace) -> Target:
    """Return the instance named by option or configuration, else the only running one.

    Raises:
        ConfigError: The name is invalid or missing in the file.
        NotRunningError: No instance is running.
        ControlError: Several instances are running.

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


@contextmanager
def opened(arguments: argparse.Namespace, *, writable: bool) -> Iterator[Cell]:
    """Open the instance that the options of ``shmio`` name, here or, with ``--host``, behind an endpoint.

    Raises:
        ConfigError: ``--host`` comes with options for an instance here, or the address is invalid.
        OSError: A file cannot be read.
        ValueRangeError: The token would go to another host in plain text.
        UnknownClientError: The instance requires a token; the message has the option for it.

    """
    if arguments.host is None:
        with Attachment(target(arguments).open(writable=writable)) as attachment:
            yield attachment
        return
    if arguments.config is not None or arguments.instance is not None:
        raise ConfigError("--host names the instance already: leave out -c and --instance")
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")  # what is wrong it tells us, too
    with ended_by_interrupt():  # gRPC crashes when it is broken off while it is loaded
        from shmio.client import connect  # noqa: PLC0415  for those who ask for it alone
    if not arguments.host.startswith(UNIX):
        Address.parse(arguments.host)
    token = arguments.token_file.read_text().strip() if arguments.token_file else None
    with connect(
        arguments.host,
        ca=arguments.ca,
        certificate=arguments.certificate,
        key=arguments.key,
        token=token,
        token_in_plain_text=arguments.token_in_plain_text,
    ) as client:
        try:
            yield client
        except UnknownClientError as error:
            if token is not None:
                raise
            raise UnknownClientError(f"{error}; here: --token-file FILE, a file with only the token") from None


def config_option(arguments: argparse.Namespace) -> str | None:
    """Return the option that names the same configuration: ``-c FILE``, or nothing for the default.

    None: the instance was named or found running, so its configuration is unknown.
    """
    if getattr(arguments, "instance", None) is not None:
        return None
    if arguments.config is not None:
        return option_for(arguments.config)
    return "" if DEFAULT_CONFIG.exists() else None


def option_for(file: Path) -> str:
    """Return the option that names a configuration; empty for the default file."""
    return "" if file == DEFAULT_CONFIG else f"-c {shlex.quote(str(file))}"


def ask(segment: Segment, request: control.Request, timeout_s: float) -> dict[str, Any]:
    """Return the supervisor's answer to a request; ControlError as soon as it appears dead."""
    try:
        return control.request(segment.header.control, request, timeout_s, lambda: supervisor_silence(segment))
    except UnreachableError as error:
        raise ControlError(f"{error}; kill -TERM {segment.supervisor[0]} stops the instance") from None


def _named_in(file: Path) -> str:
    """Read only the name from a file: an invalid file must not prevent stopping its instance."""
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
