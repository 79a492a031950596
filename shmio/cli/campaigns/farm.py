"""The options that name a farm's NATS servers."""

from __future__ import annotations

import argparse

from shmio.cli.fabric.access import access_of
from shmio.config.fabric import server_address
from shmio.errors import ConfigError
from shmio.fabric.connection import Access


def farm_of(arguments: argparse.Namespace) -> Access:
    """Return the access to the servers of the option ``--farm``.

    Raises:
        ConfigError: An option is invalid, or shmio would send plain text over the network.

    """
    access = access_of("--farm", arguments.farm.split(","), arguments)
    for url in access.servers:
        address = server_address("--farm", url, "with --credentials")
        if not (address.loopback or access.tls or url.startswith("tls:") or arguments.insecure):
            raise ConfigError(
                f"--farm: shmio would send plain text over the network to {address}, and whoever changes it can run "
                "programs on the workers; write tls://, or add --insecure"
            )
    return access
