"""The options that name a farm's NATS servers."""

from __future__ import annotations

import argparse

from shmio.config.fabric import server_address
from shmio.config.model import MqttTls
from shmio.errors import ConfigError
from shmio.fabric.connection import Access


def access_of(arguments: argparse.Namespace) -> Access:
    """Return the access to the servers that the options name.

    Raises:
        ConfigError: An address is invalid, or shmio would send plain text over the network.

    """
    ca, certificate, key = arguments.ca, arguments.certificate, arguments.key
    if (certificate is None) != (key is None):
        raise ConfigError("--certificate, --key: give both or neither")
    tls = MqttTls(ca=ca, certificate=certificate, key=key) if ca or certificate else None
    servers = tuple(arguments.farm.split(","))
    for url in servers:
        address = server_address("--farm", url, "with --credentials")
        if not (address.loopback or tls or url.startswith("tls:") or arguments.insecure):
            raise ConfigError(
                f"--farm: shmio would send plain text over the network to {address}, and whoever changes it can run "
                "programs on the workers; write tls://, or add --insecure"
            )
    return Access(servers, tls, arguments.credentials, options=True)
