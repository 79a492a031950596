"""Finds the servers of the fabric: by options, or in the configuration of an instance."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Callable, Coroutine, Sequence
from typing import TYPE_CHECKING, Any

from shmio.cli.common import ended_by_interrupt
from shmio.cli.target import target
from shmio.config.fabric import server_address
from shmio.config.model import MqttTls
from shmio.config.read import load
from shmio.errors import ConfigError, ControlError, NotRunningError
from shmio.fabric.connection import INSTALL, Access, call_once
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.client import Client

_REMEDY = "name a server with --server nats://HOST:4222"


def access(options: argparse.Namespace) -> Access:
    """Return the servers that the options name, or else those of an instance.

    Raises:
        ConfigError: Options do not fit together, or the instance has no fabric.
        ControlError: Several instances are running.

    """
    if options.server is None:
        for name in ("credentials", "ca", "certificate", "key"):
            if getattr(options, name) is not None:
                raise ConfigError(f"--{name}: this option needs --server; without it, the command uses [fabric]")
        return _configured(options)
    if options.config is not None or options.instance is not None:
        raise ConfigError("--server already names the fabric; remove -c and --instance")
    return access_of("--server", options.server, options)


def access_of(key: str, servers: Sequence[str], options: argparse.Namespace) -> Access:
    """Return the access to servers by ``--credentials``, ``--ca``, ``--certificate`` and ``--key``.

    Args:
        key: The option that names the servers, for messages.
        servers: Their URLs.
        options: The options of the command.

    Raises:
        ConfigError: A URL is wrong, or the options do not fit together.

    """
    for url in servers:
        server_address(key, url, "with --credentials")
    if (options.certificate is None) != (options.key is None):
        raise ConfigError("--certificate: give both --certificate and --key, or neither")
    tls = MqttTls(options.ca, options.certificate, options.key) if options.ca or options.certificate else None
    return Access(tuple(servers), tls, options.credentials, options=True)


def _configured(options: argparse.Namespace) -> Access:
    try:
        found = target(options)
    except NotRunningError as error:
        raise ConfigError(f"{error}; {_REMEDY}") from None
    file = found.file
    if file is None:
        with found.open() as segment:
            file = segment.config
    if file is None:
        raise ControlError(f"the configuration of instance {found.name} is unknown; {_REMEDY}")
    fabric = load(file).fabric
    if fabric is None:
        raise ConfigError(f"{file}: fabric: this table is missing; {_REMEDY}")
    return Access.of(fabric)


def with_client(options: argparse.Namespace, work: Callable[[Client], Coroutine[Any, Any, Any]]) -> Any:
    """Connect to the fabric, and return the result of ``work`` with the connection.

    Raises:
        ConfigError: The servers are not known, or a file cannot be used.
        RemoteError: No server can be reached, or it refuses access.

    """
    place = access(options)
    with ended_by_interrupt():
        library("nats", INSTALL)
    return asyncio.run(call_once(place, work))
