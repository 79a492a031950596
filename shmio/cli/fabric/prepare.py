"""``shmio fabric prepare``: creates what the servers keep, which the cells themselves may not do."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import msgspec

from shmio.cli.common import dumps
from shmio.cli.fabric.access import with_client
from shmio.config.model import FabricHistory
from shmio.errors import ConfigError, RemoteError
from shmio.fabric.connection import INSTALL
from shmio.fabric.history_stream import create_history
from shmio.fabric.names import CellName
from shmio.fabric.registry import BUCKETS, Registry
from shmio.libraries import library

if TYPE_CHECKING:
    from nats.aio.client import Client


def execute(options: argparse.Namespace) -> int:
    """Create the registry, and the histories of the cells that the options name."""
    cells = [CellName.parse(name) for name in options.history]
    given = {"keep_days": options.keep_days, "keep_mb": options.keep_mb}
    for name, value in given.items():
        if value is not None and not cells:
            raise ConfigError(f"--{name.replace('_', '-')}: this option needs --history")
    limits = {name: value for name, value in given.items() if value is not None}
    try:
        settings = msgspec.convert({**limits, "replicas": options.replicas}, FabricHistory)
    except msgspec.ValidationError as error:
        raise ConfigError(f"the limits of a history: {error}") from None

    async def work(client: Client) -> None:
        await (await Registry.open(client, replicas=options.replicas)).spread(options.replicas)
        for cell in cells:
            try:
                await create_history(client, cell, settings)
            except library("nats.js.errors", INSTALL).Error as error:
                why = getattr(error, "description", None) or error
                raise RemoteError(f"{cell}: the servers do not create the history: {why}") from None

    with_client(options, work)
    if options.json:
        print(dumps({"buckets": list(BUCKETS), "histories": [cell.history for cell in cells]}))
    else:
        print("the servers have a registry: the cells can join now")
        for cell in cells:
            print(f"the servers keep the history of {cell}")
    return 0
