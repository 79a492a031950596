"""The options that name a farm's NATS servers."""

from __future__ import annotations

import argparse
from typing import Final
from urllib.parse import urlsplit

from shmio.config.address import Address
from shmio.config.model import MqttTls
from shmio.errors import ConfigError
from shmio.fabric.connection import Access

PORT: Final = 4222
SCHEMES: Final = ("nats", "tls")


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
        address = _address(url)
        if not (address.loopback or tls or url.startswith("tls:") or arguments.insecure):
            raise ConfigError(
                f"--farm: shmio would send plain text over the network to {address}, and whoever changes it can run "
                "programs on the workers; write tls://, or add --insecure"
            )
    return Access(servers, tls, arguments.credentials)


def _address(url: str) -> Address:
    """Return the address in the URL of a server."""
    try:
        parts = urlsplit(url)
        port = parts.port or PORT
    except ValueError:
        parts, port = urlsplit(""), 0
    if parts.scheme not in SCHEMES or not parts.hostname or parts.path.strip("/") or parts.query or parts.fragment:
        raise ConfigError(f"--farm: {url!r} is not a NATS server; write nats://host:{PORT} or tls://host:{PORT}")
    if parts.password or parts.username:
        raise ConfigError("--farm: a URL with a password is visible to others; name a file with --credentials")
    return Address(parts.hostname, port)
